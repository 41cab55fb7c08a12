"""What tests try less of where little time is meant: in `make quick`, and in `make test`."""

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import settings

QUICK = settings.default.max_examples < 50  # which the usual profile has, in conftest.py


def some(slow: Sequence[Any], *, exhaustive: Sequence[Any]) -> list[Any]:
    """Return the cases of a test of which `make test` tries some,
    and the rest prove the same of others.
    """
    return [_case(each, pytest.mark.slow) for each in slow] + [
        _case(each, pytest.mark.exhaustive) for each in exhaustive
    ]


def _case(values: Any, tier: pytest.MarkDecorator) -> Any:
    return pytest.param(*(values if isinstance(values, tuple) else (values,)), marks=tier)
