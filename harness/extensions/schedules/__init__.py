"""Compare whom the ego asks, and when, over stored runs, and learn it from them."""

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
)
