"""Any environment of highway-env as a scenario: `env:merge-v0`, `env:my_package:MyEnv-v0`.

Vehicles, traffic and ends are the environment's; docs/environments.md says what it must offer.
"""
