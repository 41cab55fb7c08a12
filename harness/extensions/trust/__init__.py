"""Let some helpers lie or fail, guard what the ego hears, and study both together."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.trust"

EXTENSION = Extension(
    name="trust",
    commands={"study trust": f"{_HERE}.command:command"},
    spellings={"trust": "study trust"},
    studies={"trust": "trust"},
    kinds={"attacks": "what liars say"},
    adds={
        "parts": {"trust": f"{_HERE}.part:Guard"},
        "python": {"Attack": f"{_HERE}.attacks:Attack", "Turn": f"{_HERE}.attacks:Turn"},
    },
)
