"""Teach models and tune prompts: a search over a prompt's wordings, and rewards from trees."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.learn"

EXTENSION = Extension(
    name="learn",
    commands={"prompt optimize": f"{_HERE}.optimize.command:command"},
    studies={"optimize": "optimize"},
    adds={"python": {"environment": f"{_HERE}.rewards.python_api:environment"}},
)
