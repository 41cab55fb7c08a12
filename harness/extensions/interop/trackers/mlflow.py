"""Runs in MLflow, at `MLFLOW_TRACKING_URI`:
settings as parameters, figures as metrics, the page as well.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.extensions.interop.trackers import flat

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated

AT_ONCE = 100  # parameters, by MLflow's limit


class Mlflow:
    """Record runs in the tracker MLflow while they go, for `--tracker mlflow`.

    It is a hook, a plug-in that follows runs. It logs settings as parameters, the number of
    answers, and at the end figures and files.
    """

    needs = ("mlflow",)  # without which it cannot begin

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        import mlflow

        mlflow.start_run(run_name=folder.name)
        params = list(flat.params(settings).items())
        for start in range(0, len(params), AT_ONCE):
            mlflow.log_params(dict(params[start : start + AT_ONCE]))

    def answered(self, total: int) -> None:
        import mlflow

        mlflow.log_metric("answers", total, step=total)

    def end(self, done: "Evaluated | None") -> None:
        import mlflow

        if done:
            mlflow.log_metrics({_name(name): value for name, value in flat.figures(done).items()})
            for file in flat.files(done):
                mlflow.log_artifact(str(file))
        mlflow.end_run("FINISHED" if done else "KILLED")


def _name(figure: str) -> str:
    """Return a figure's name with the characters that MLflow takes."""
    return re.sub(r"[^\w./ :-]", "_", figure)


TRACKER = Mlflow()
