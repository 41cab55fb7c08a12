"""Audit whether what the ego sees gives away what it cannot see, in a scenario or a new dataset."""

from harness.core.extensions import Extension

SKLEARN = ("scikit-learn", "audit")

EXTENSION = Extension(
    name="audit",
    commands={"dataset scenario audit": "harness.extensions.audit.command:command"},
    adds={
        "audits": {"tells": "harness.extensions.audit.tells:OF_DATASETS"},
        "extras": {"sklearn": "harness.extensions.audit:SKLEARN"},
    },
)
