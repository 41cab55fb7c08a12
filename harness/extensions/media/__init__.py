"""Draw driven episodes as videos: one of a run, or those of a new run that failed."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="media",
    commands={"run video": "harness.extensions.media.command:command"},
    spellings={"video": "run video"},
    adds={"videos": {"failures": "harness.extensions.media.failures:FAILURES"}},
)
