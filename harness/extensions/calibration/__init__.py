"""Correct a model's probabilities by what was fitted on tune layouts."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="calibration",
    commands={"model calibrate": "harness.extensions.calibration.command:command"},
    adds={"parts": {"calibration": "harness.extensions.calibration.part:Calibrated"}},
)
