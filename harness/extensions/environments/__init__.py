"""Let any environment of highway-env be a scenario: `env:merge-v0`, `env:my_package:MyEnv-v0`."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="environments",
    adds={"families": {"env": "harness.extensions.environments.family:ENVIRONMENTS"}},
)
