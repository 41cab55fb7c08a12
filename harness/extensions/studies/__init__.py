"""Ask beyond one run: repeats, twins of questions, what moved answers, frozen against driven."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.studies"

EXTENSION = Extension(
    name="studies",
    commands={
        "study repeats": f"{_HERE}.repeats.command:command",
        "study twins": f"{_HERE}.twins.command:command",
        "study attribute": f"{_HERE}.attribution.command:command",
        "study fidelity": f"{_HERE}.fidelity.command:command",
    },
    spellings={
        "twins": "study twins",
        "attribute": "study attribute",
        "fidelity": "study fidelity",
        "eval --repeats": "study repeats",
    },
    studies={"repeats": "repeats", "twins": "twins", "fidelity": "study"},
    adds={"remarks": {"attribution": f"{_HERE}.attribution.remarks:REMARKS"}},
)
