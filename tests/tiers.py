"""What tests of wide properties try less of in `make quick`."""

from hypothesis import settings

QUICK = settings.default.max_examples < settings.get_profile("harness").max_examples
