"""Teach models and tune prompts: what trees show to be right, distilling, rewards,
a search of wordings.
"""

from harness.core.extensions import Extension

_HERE = "harness.extensions.learn"

GEPA = ("gepa", "gepa")

EXTENSION = Extension(
    name="learn",
    commands={
        "model distill": f"{_HERE}.training.commands:distill",
        "prompt examples": f"{_HERE}.training.commands:examples",
        "prompt optimize": f"{_HERE}.optimize.command:command",
    },
    spellings={"distill": "model distill"},
    studies={"optimize": "optimize"},
    adds={
        "exports": {"sft": f"{_HERE}.training.exports:SFT", "dpo": f"{_HERE}.training.exports:DPO"},
        "extras": {"gepa": f"{_HERE}:GEPA"},
        "python": {"environment": f"{_HERE}.rewards.python_api:environment"},
    },
)
