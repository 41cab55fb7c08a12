"""Teach models and tune prompts: a search over a prompt's wordings on tune layouts."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.learn"

EXTENSION = Extension(
    name="learn",
    commands={"prompt optimize": f"{_HERE}.optimize.command:command"},
    studies={"optimize": "optimize"},
)
