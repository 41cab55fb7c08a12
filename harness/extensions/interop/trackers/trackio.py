"""Runs in Trackio, on this machine, or in the space that `TRACKIO_SPACE_ID` names."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.extensions.interop.trackers import flat

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated


class Trackio:
    """Record runs in the tracker Trackio while they go, for `--tracker trackio`.

    It is a hook, a plug-in that follows runs. It logs settings, the number of answers, and at the
    end figures.
    """

    needs = ("trackio",)  # without which it cannot begin

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        import trackio

        project = os.environ.get("TRACKIO_PROJECT") or flat.PROJECT
        trackio.init(project=project, name=folder.name, config=flat.params(settings))

    def answered(self, total: int) -> None:
        import trackio

        trackio.log({"answers": total})

    def end(self, done: "Evaluated | None") -> None:
        import trackio

        if done:
            trackio.log(flat.figures(done))
        trackio.finish()


TRACKER = Trackio()
