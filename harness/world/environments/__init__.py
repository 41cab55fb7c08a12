"""Any environment of highway-env as a scenario: `env:merge-v0`, `env:my_package:MyEnv-v0`.

The environment provides vehicles, traffic and endings;
docs/environments.md says what it must offer.
"""
