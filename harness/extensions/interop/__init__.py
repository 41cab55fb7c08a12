"""Runs in programs of others: trackers that follow them, records, and logs, also of others."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.interop"

# The package of each program, and its extra.
INSPECT = ("inspect-ai", "inspect")
MLFLOW = ("mlflow-skinny", "mlflow")
TRACKIO = ("trackio", "trackio")
WANDB = ("wandb", "wandb")

EXTENSION = Extension(
    name="interop",
    kinds={"hooks": "what is told of a run while it goes, such as a tracker"},
    adds={
        "extras": {
            "inspect_ai": f"{_HERE}:INSPECT",
            "mlflow": f"{_HERE}:MLFLOW",
            "trackio": f"{_HERE}:TRACKIO",
            "wandb": f"{_HERE}:WANDB",
        },
        "exports": {
            "every-eval": f"{_HERE}.exports:EVERY_EVAL",
            "inspect": f"{_HERE}.exports:INSPECT",
        },
        "hooks": {
            "mlflow": f"{_HERE}.trackers.mlflow:TRACKER",
            "trackio": f"{_HERE}.trackers.trackio:TRACKER",
            "wandb": f"{_HERE}.trackers.wandb:TRACKER",
        },
        "logs": {"inspect": f"{_HERE}.logs:INSPECT", "lm-eval": f"{_HERE}.logs:LM_EVAL"},
        "options": {"tracker": f"{_HERE}.option:TRACKER"},
        "python": {"Hook": f"{_HERE}.hooks:Hook"},
    },
)
