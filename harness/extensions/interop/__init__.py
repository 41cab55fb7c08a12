"""Runs in programs of others: trackers that follow them, and a log."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.interop"

EXTENSION = Extension(
    name="interop",
    adds={
        "exports": {"inspect": f"{_HERE}.exports:INSPECT"},
        "hooks": {
            "mlflow": f"{_HERE}.trackers.mlflow:TRACKER",
            "trackio": f"{_HERE}.trackers.trackio:TRACKER",
            "wandb": f"{_HERE}.trackers.wandb:TRACKER",
        },
    },
)
