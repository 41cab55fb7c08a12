"""Runs in Weights & Biases, where its own variables say:
`WANDB_PROJECT`, `WANDB_MODE`, `WANDB_API_KEY`.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.extensions.interop.trackers import flat

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated


class Wandb:
    """Record runs in the tracker Weights & Biases while they go, for `--tracker wandb`.

    It is a hook, a plug-in that follows runs. It logs settings, the number of answers, and at the
    end figures and files.
    """

    needs = ("wandb",)  # without which it cannot begin

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        import wandb

        project = os.environ.get("WANDB_PROJECT") or flat.PROJECT
        self._run = wandb.init(project=project, name=folder.name, config=flat.params(settings))

    def answered(self, total: int) -> None:
        self._run.log({"answers": total})

    def end(self, done: "Evaluated | None") -> None:
        import wandb

        if done:
            self._run.summary.update(flat.figures(done))
            kept = wandb.Artifact(f"run-{self._run.id}", "run")
            for file in flat.files(done):
                kept.add_file(str(file))
            self._run.log_artifact(kept)
        self._run.finish(exit_code=0 if done else 1)


TRACKER = Wandb()
