"""Serve a model's decisions to other programs: both wire shapes, and the queue before the model."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="decide",
    commands={"serve": "harness.extensions.decide.command:command"},
    panels={"serve": "More"},
)
