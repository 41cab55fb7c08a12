"""Play the paper's studies: a calibrated proxy beside each of its numbers,
and any model in closed loop.
"""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="paper",
    commands={
        "study paper": "harness.extensions.paper.commands:paper",
        "study closed-loop": "harness.extensions.paper.commands:closed_loop",
    },
    spellings={"campaign": "study"},
    studies={"study": "study", "closed-loop": "study"},
    adds={"sources": {"proxy": "harness.extensions.paper.calibrated:SWEPT"}},
)
