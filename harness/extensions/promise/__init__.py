"""Promise how often a model does harm: thresholds that are chosen on tune layouts."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.promise"

EXTENSION = Extension(
    name="promise",
    commands={"study promise": f"{_HERE}.command:command"},
    studies={"promise": "promise"},
    adds={
        "parts": {"promise": f"{_HERE}.part:Careful"},
        "caveats": {"promise": f"{_HERE}.caveat:caveats"},
    },
)
