"""`harness study closed-loop`: the paper's panels where a car can crash, driven by any model.

All grid points are conditions of one live run. Their episodes share worlds for as long as they go
the same way (docs/decisions/0014), so a grid costs far less than its points one by one.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harness.coordination.named_points import POINTS, named_point
from harness.core.figures import crossed
from harness.core.parallel import Workers
from harness.core.work import tidy
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.run import evaluate, finished_run
from harness.evaluate.spec import Spec
from harness.radio.constant import density_coupled_loss
from harness.runs.records import ClosedLoop, Score
from harness.studies.axes import AXES, CORE, Setting, Value, described, grid
from harness.studies.figures.described import Draws
from harness.studies.play import ENDS, PER_DECISION
from harness.studies.study import Study
from harness.studies.sweep import in_a_sentence, tables

if TYPE_CHECKING:
    import pandas as pd

SHOWN = (*ENDS, *PER_DECISION)
VEHICLES = 4  # the ego and the scenario's three helpers
RUN = "run"  # the live run's folder


def panels() -> dict[str, list[Setting]]:
    """Return what the SwarmDrive paper's study varies, by panel, to be driven in the simulator.

    A panel is a set of operating points (settings of radio, asking and fusion) that one figure
    shows: the paper's own, or others by number of vehicles (`size`), packet loss (`loss`), or
    `tau`, the entropy in nats above which the ego asks. In `size`, loss grows with the density of
    vehicles.
    """

    def setting(panel: str, value: Value, vehicles: int, changes: str) -> Setting:
        return Setting("6g", named_point(f"6g:{changes}"), vehicles, panel, value)

    sizes = []
    for vehicles, loss in enumerate(density_coupled_loss(np.arange(1, VEHICLES + 1)), 1):
        changes = f"max_helpers={vehicles - 1},loss={loss:g}"
        sizes.append(setting("size", vehicles, vehicles, changes))
    losses, taus = grid(AXES["loss"]), grid(AXES["tau"])
    return {
        CORE: [Setting(name, point, VEHICLES) for name, point in POINTS.items()],
        "size": sizes,
        "loss": [setting("loss", v, VEHICLES, f"loss={v:g}") for v in losses],
        "tau": [setting("tau", v, VEHICLES, f"tau_nats={v:g}") for v in taus],
    }


def run_closed_loop(
    spec: Spec, out: Path, workers: Workers, progress: Callable[[int], None], cache: Path | None
) -> Study:
    """Drive a model in the simulator under every setting that the SwarmDrive paper varies.

    The settings are those of radio and asking: the paper's own, other numbers of vehicles, packet
    loss, and `tau`, the entropy above which the ego asks. All are played in one run, in the folder
    `out/run`.

    Args:
        spec: the evaluation: the model, prompt, scenario and layouts (start situations).
        out: the study's folder; a study that was stopped there continues.
        workers: the number of processes, or a cluster.
        progress: called with the number of layouts just driven under all settings.
        cache: the file of stored completions; None for none.

    Returns the study: sentences, tables and figures of success, crashes and latency under each
    setting, with 95 % intervals over episodes.
    """
    if (out / RUN / "run.json").is_file():
        stored = finished_run(spec, out / RUN)
        done = Evaluated(stored.path, stored.manifest, stored.scores)
    else:
        done = evaluate(spec, out / RUN, progress, cache, workers=workers)
    tidy(out / RUN)
    grids = panels()
    summary = _summary(done, grids)
    core, *sweeps = (summary[summary.panel == name] for name in grids)
    main_tables = tables(summary)
    m, world = done.manifest, cast(ClosedLoop, done.manifest.world)
    return Study(
        "closed-loop",
        f"The paper's panels, driven: {m.variant} · {world.title}",
        [f"{table.title}: {in_a_sentence(table)}." for table in main_tables],
        [
            f"Every grid point was driven in closed loop on the layouts of {world.title}; n = "
            f"{crossed(world.episodes, len(m.seeds))} (channel seeds "
            f"{', '.join(map(str, m.seeds))}), and "
            "95 % intervals are over episodes. "
            "conditions.csv has all figures with their n, and run/ the driven episodes."
        ],
        main_tables,
        {"conditions": summary},
        {"run": RUN, "panels": described(grids), "versions": m.versions},
        summary,
        lambda draws: _figures(draws, core, sweeps),
    )


def _figures(
    draws: Draws[Any], core: "pd.DataFrame", sweeps: "Sequence[pd.DataFrame]"
) -> dict[str, Any]:
    return {"figure-a": draws.operating_points(core), "figure-b": draws.along(sweeps)}


def _summary(done: Evaluated, grids: Mapping[str, Sequence[Setting]]) -> "pd.DataFrame":
    """Return the live run's figures as a study has them."""
    import pandas as pd

    source = f"{done.manifest.variant}, driven"
    by_point: dict[str, list[Score]] = {}
    for score in done.scores:
        if score.metric in SHOWN or score.metric.startswith(("latency_p", "collision")):
            by_point.setdefault(score.condition, []).append(score)
    rows = []
    for panel, settings in grids.items():
        for setting in settings:
            for score in by_point[setting.point.name]:
                row = {
                    "source": source,
                    "panel": panel,
                    "condition": setting.condition,
                    "variable": setting.variable,
                    "value": setting.value,
                    "metric": score.metric,
                    "mean": score.value,
                    "ci_low": score.low,
                    "ci_high": score.high,
                    "n": score.n,
                    "interval": score.interval,
                }
                rows.append(row)
    return pd.DataFrame(rows)
