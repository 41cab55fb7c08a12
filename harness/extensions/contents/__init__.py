"""Let messages hold words, objects or both in place of an intent, and study what they should."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.contents"

EXTENSION = Extension(
    name="contents",
    commands={"study contents": f"{_HERE}.command:command"},
    studies={"contents": "contents"},
    adds={
        "contents": {
            "text": f"{_HERE}.text:TEXT",
            "objects": f"{_HERE}.objects:OBJECTS",
            "both": f"{_HERE}.objects:BOTH",
            "oracle": f"{_HERE}.objects:ORACLE",
        }
    },
)
