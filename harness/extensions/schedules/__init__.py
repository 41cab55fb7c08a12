"""Let the ego ask otherwise than the paper's does, and compare and learn whom it asks, and when."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.schedules"

EXTENSION = Extension(
    name="schedules",
    commands={
        "study schedule compare": f"{_HERE}.command:compare",
        "study schedule learn": f"{_HERE}.command:learn",
    },
    groups={"study schedule": "Compare schedules (whom to ask, and when), or learn one."},
    spellings={"schedule": "study schedule"},
    studies={"schedule": "schedule"},
    adds={
        "schedules": {
            "always": f"{_HERE}.formulas:ALWAYS",
            "margin": f"{_HERE}.formulas:MARGIN",
            "risk": f"{_HERE}.formulas:RISK",
            "deadline": f"{_HERE}.formulas:DEADLINE",
            "coverage": f"{_HERE}.formulas:COVERAGE",
            "random": f"{_HERE}.formulas:RANDOM",
        },
        "readers": {"schedules": f"{_HERE}.learnt:read"},
    },
)
