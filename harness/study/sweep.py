"""`harness sweep`: stored answers at every point of a grid."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import UserError, printable, unknown
from harness.files import write_whole
from harness.run.spec import versions
from harness.study import figures
from harness.study.axes import Axis, Value
from harness.study.play import Setting, play
from harness.study.stored import Stored

if TYPE_CHECKING:
    import pandas as pd

FORMAT = "swarmdrive-sweep/1"


def settings(
    sources: Sequence[Stored], axis: Axis, values: Sequence[Value], condition: str
) -> tuple[Setting, ...]:
    """The grid points of one axis.

    Raises:
        UserError: no such condition in a run, one without a channel, or more vehicles than there are.
    """
    for source in sources:
        if condition not in source.points:
            raise unknown(f"condition of {printable(source.run.path)}", condition, source.points)
    point, vehicles = sources[0].points[condition], min(source.vehicles for source in sources)
    if point.profile is None:
        raise UserError(f"--condition {printable(condition)} has no channel; nothing of it can be varied")
    if axis.field is None and max(map(float, values)) > vehicles:
        raise UserError(
            f"--grid: {max(map(float, values)):g} vehicles; the run's scenes have {vehicles} at most"
        )
    return tuple(
        Setting(condition, axis.at(point, v), vehicles if axis.field else int(v), axis.name, v)
        for v in values
    )


def run_sweep(
    sources: Sequence[Stored], panels: Mapping[str, Sequence[Setting]], seeds: Sequence[int], out: Path,
    progress: Callable[[int], None],
) -> "pd.DataFrame":  # fmt: skip
    """Play every run at every grid point; points and runs are paired by common random numbers.

    Writes `conditions.csv`, `episodes.csv`, `sweep.json`, and the panels as SVG, PDF and PNG.

    Returns:
        The summary: a row a run, grid point and metric.
    """
    import pandas as pd

    played = {
        name: [play(source, name, points, seeds, progress) for source in sources]
        for name, points in panels.items()
    }
    by_panel = [pd.concat([p.summary for p in made], ignore_index=True) for made in played.values()]
    summary = pd.concat(by_panel, ignore_index=True)
    out.mkdir(parents=True, exist_ok=True)
    figures.save_all(figures.along(by_panel), out / "sweep")
    episodes = pd.concat([p.episodes for made in played.values() for p in made], ignore_index=True)
    write_whole(out / "conditions.csv", summary.to_csv(index=False))
    write_whole(out / "episodes.csv", episodes.to_csv(index=False))
    manifest = {
        "format": FORMAT,
        "runs": [
            {"path": str(s.run.path), "name": s.name, "dataset": s.run.config["dataset"]["sha256"]}
            for s in sources
        ],
        "seeds": list(seeds),
        "grid": {name: [s.value for s in points] for name, points in panels.items()},
        "versions": versions(),
    }
    write_whole(out / "sweep.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    return summary
