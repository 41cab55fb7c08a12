"""How far success on frozen scenes is success in closed loop, of models' runs.

Runs of the same model, prompt and answer mode are compared episode by episode:
the same layout, condition and channel seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import asdict

from harness.core.errors import UserError, printable
from harness.core.statistics import joined_clusters
from harness.core.versions import versions
from harness.extensions.studies.fidelity.chart import chart
from harness.report.document import Chart, Table
from harness.runs.alike import different, setup
from harness.runs.contradictions import sound
from harness.runs.folder import Run
from harness.runs.metric import World
from harness.runs.records import Variant
from harness.runs.run_dataset import dataset_of
from harness.studies.both_worlds import COMPARED, compared

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from harness.studies.figures.described import Draws
    from harness.studies.study import Study

WHO = Variant.__struct_fields__
KEY = (*WHO, "condition", "seed", "layout_seed")
ENDS = ("", "_low", "_high")  # of the columns of an estimate
DRAWN = [f"{world}{end}" for world in ("frozen", "closed") for end in ENDS]
LEAST_RANKED = 5  # four in the same order are chance in 1 of 12, five in 1 of 60, both ways round
PLACE = "model · prompt · answers, condition"
SHOWN = 20  # ways to disagree that the page lists


@dataclass(frozen=True)
class Fidelity:
    """Hold the comparison of success on frozen scenes with success in closed loop.

    On frozen scenes, models decide at recorded points; in closed loop they drive in the simulator.
    A condition is a set of settings of radio, asking and fusion, by its name. `table` has a row for
    each model, prompt, answer mode and condition, with both rates (`frozen`, `closed`), their
    `difference` and the share of episodes that end alike (`agreement`); `episodes` one for each
    episode, condition and seed. `rank` is Spearman's correlation of both rates over `ranked` rows,
    NaN for too few.
    """

    # a row a model, prompt, answer mode and condition: `frozen`, `closed`, `difference` (frozen
    # minus closed, paired by episode) and `agreement` (share of episodes and seeds with the same
    # result), each with `_low` and `_high`, and `n` episodes; shares from 0 to 1
    table: "pd.DataFrame"
    # a row an episode, condition and seed, with the result and the failure of both
    episodes: "pd.DataFrame"
    # Spearman's correlation of `frozen` and `closed` over the rows of `table`; conditions that make
    # no difference to a model count once. NaN for fewer than `LEAST_RANKED` rows, or where all are
    # alike
    rank: float
    ranked: int  # how many rows that is over


def fidelity(runs: Sequence[Path]) -> Fidelity:
    """Compare runs of `harness eval` (frozen scenes) with runs of `harness drive` (closed loop).

    `runs` are their folders. They are paired by episode, channel seed and condition (settings of
    radio, asking and fusion).

    Raises:
        UserError: a folder is no run, a kind of run is missing, two runs have the same episodes, or
            no episode is in runs of both kinds; or two that are paired differ in their scenario, or
            in what they ask and time.
    """
    import pandas as pd

    by_world: dict[World, list[pd.DataFrame]] = {"frozen": [], "closed-loop": []}
    read = [sound(path) for path in runs]
    for number, run in enumerate(read):
        by_world[run.world].append(_episodes(run).assign(run=number))
    sources = {
        "frozen": "frozen scenes (harness eval)",
        "closed-loop": "live episodes (harness drive)",
    }
    for world, tables in by_world.items():
        if not tables:
            raise UserError(
                f"no run on {sources[world]} among {len(runs)} folders; give at least one of each "
                "kind"
            )
    frozen, closed = (pd.concat(tables, ignore_index=True) for tables in by_world.values())
    for each in (frozen, closed):
        if each.duplicated(list(KEY)).any():
            raise UserError(
                "two of the runs have the same episodes; give one run of each model and prompt"
            )
    both = frozen.merge(closed, on=list(KEY), suffixes=("_frozen", "_closed"))
    if both.empty:
        raise UserError(
            "the runs have no episode in common; give runs of the same model, prompt and answer "
            "mode, with the same conditions, seeds and layouts (harness drive --first-seed)"
        )
    pairs = both[["run_frozen", "run_closed"]].drop_duplicates()
    for one, other in pairs.itertuples(index=False):
        _refuse_unlike(read[one], read[other])
    both = both.drop(columns=["run_frozen", "run_closed"])
    rows = pd.DataFrame(_rows(both))
    both = both.drop(columns=["cluster_frozen", "cluster_closed"])
    return Fidelity(rows, both, *_rank(rows))


def _rank(rows: "pd.DataFrame") -> tuple[float, int]:
    distinct = rows.drop_duplicates([*WHO, "frozen", "closed"])
    if (
        len(distinct) < LEAST_RANKED
        or distinct.frozen.nunique() == 1
        or distinct.closed.nunique() == 1
    ):
        return np.nan, len(distinct)
    ranks = distinct[["frozen", "closed"]].rank()
    return float(ranks.frozen.corr(ranks.closed)), len(distinct)


def _refuse_unlike(frozen: Run, driven: Run) -> None:
    """Raise UserError if two runs differ in more than their worlds."""
    unlike = different(
        setup(frozen, dataset_of(frozen).scenario), setup(driven, driven.manifest.scenario)
    )
    if unlike:
        one, other = printable(frozen.path), printable(driven.path)
        raise UserError(
            f"{one} and {other} differ in {unlike}; give runs that differ in their world alone"
        )


def _episodes(run: Run) -> "pd.DataFrame":
    """Return the result of each of a run's episodes, on the layouts of its dataset if it has one.

    A file may state any seeds: those of a driven run are held to its first one as it is read.
    """
    import pandas as pd

    columns = ("condition", "seed", "layout_seed", "success", "failure", "cluster", "episode")
    rows = [attrgetter(*columns)(episode) for episode in run.episodes]
    table = pd.DataFrame(rows, columns=list(columns))
    if run.world == "frozen":
        dataset = dataset_of(run)
        seed_of = {number: dataset.manifest.seed + number for number in run.grid.episodes}
        cluster_of = {n: dataset.scenario.cluster_of(seed) for n, seed in seed_of.items()}
        table["layout_seed"] = [seed_of[number] for number in table.episode]
        table["cluster"] = [cluster_of[number] for number in table.episode]
    return table.drop(columns=["episode"]).assign(**asdict(run.manifest.variant))


def _rows(both: "pd.DataFrame") -> Iterator[dict[str, Any]]:
    """Yield a row of `Fidelity.table` for each model, prompt, answer mode and condition."""
    columns = [*WHO, "condition"]
    for place, group in both.groupby(columns, sort=False):
        values = ["success_frozen", "success_closed"]
        wide = group.pivot(index="seed", columns="layout_seed", values=values)
        frozen = wide["success_frozen"].to_numpy(dtype=float)
        closed = wide["success_closed"].to_numpy(dtype=float)
        row = dict(zip(columns, place, strict=True))
        partitions = []
        for world in ("frozen", "closed"):
            cluster_of = dict(zip(group.layout_seed, group[f"cluster_{world}"], strict=True))
            partitions.append([cluster_of[layout] for layout in wide["success_frozen"]])
        clusters = joined_clusters(partitions)
        for name, estimate in compared(frozen, closed, clusters).items():
            row[name] = estimate.value
            row[f"{name}_low"] = estimate.low
            row[f"{name}_high"] = estimate.high
        row["n"] = group.layout_seed.nunique()
        yield row


def disagreements(both: "pd.DataFrame") -> "pd.DataFrame":
    """Count the episodes that succeeded in only one of the worlds, by how they ended in both.

    The worlds are frozen (recorded) scenes and the closed loop (driven in the simulator). `both` is
    `Fidelity.episodes`. The table has a row for each model, prompt, answer mode, condition
    (settings of radio, asking and fusion), `frozen_end` and `closed_end` (`success` or a failure),
    with `count`, the most frequent first.
    """
    ends = both.assign(
        frozen_end=both.failure_frozen.where(~both.success_frozen, "success"),
        closed_end=both.failure_closed.where(~both.success_closed, "success"),
    )
    differing = ends[ends.success_frozen != ends.success_closed]
    places = [*WHO, "condition", "frozen_end", "closed_end"]
    counts = differing.groupby(places, sort=False).size().rename("count").reset_index()
    return counts.sort_values("count", ascending=False, kind="stable")


def fidelity_study(result: Fidelity, runs: Sequence[Path]) -> "Study":
    """Return the study (table, figure and sentences) that compares frozen with driven runs.

    Frozen runs decide on recorded scenes, driven ones in the simulator. `result` has the comparison
    of their success, and `runs` are the folders that the study names as sources.
    """
    from harness.studies.study import Study, percent

    rows, ends_rows = list[Sequence[str]](), list[Sequence[str]]()
    for row in result.table.to_dict("records"):
        cells = [percent(row, name, f"{name}_low", f"{name}_high") for name in COMPARED]
        rows.append((_place(row), *cells, str(row["n"])))
    for row in disagreements(result.episodes).head(SHOWN).to_dict("records"):
        ends = (row["frozen_end"], row["closed_end"], str(row["count"]))
        ends_rows.append((_place(row), *ends))
    heads = (PLACE, "frozen %", "closed loop %", "difference, points", "same %", "n")
    ends_heads = (PLACE, "end on frozen scenes", "end in closed loop", "episodes × seeds")
    return Study(
        "fidelity",
        "Frozen and closed loop compared",
        headline(result),
        [
            "On frozen scenes, success is looked up: the outcome of each action was found in "
            "advance, by driving on with a planner that sees everything. The same models, under "
            "the same conditions and seeds, also drove the same layouts in closed loop. There an "
            "action takes effect as late as its decision took, and each action changes what comes "
            "next.",
            "Paired by episode, condition and channel seed; n is the number of episodes, each "
            "averaged over its seeds; 95 % intervals are over episodes. A point below the "
            "figure's dashed line succeeds less often in closed loop.",
        ],
        [
            Table("Side by side", heads, rows, terminal=(0, 1, 2, 3, 4)),
            Table("Where they disagree", ends_heads, ends_rows),
        ],
        {"fidelity": result.table, "episodes": result.episodes},
        {"sources": [{"name": str(run)} for run in runs], "versions": versions()},
        result.table,
        lambda draws: {"fidelity": _scatter(draws, result)},
    )


def _scatter(draws: "Draws[Any]", result: Fidelity) -> Any:
    models = [_who(row) for row in result.table.to_dict("records")]

    def picture() -> "Figure":
        from harness.extensions.studies.fidelity.figure import scatter

        return scatter(result.table, models)

    def points() -> list[Chart]:
        rows = []
        for model, row in zip(models, result.table.to_dict("records"), strict=True):
            percents = {name: 100 * row[name] for name in DRAWN}
            rows.append({"model": model, "condition": row["condition"], **percents})
        return [chart(rows)]

    return draws.either(picture, points)


def headline(result: Fidelity) -> list[str]:
    """Return sentences on how far success on recorded scenes is from that in the simulator.

    They name the largest difference, and the rank correlation or why there is none. `result` has
    the comparison of both.
    """
    rows: list[dict[Any, Any]] = result.table.to_dict("records")
    worst = max(rows, key=lambda row: abs(row["difference"]))
    points, low, high = (100 * worst[f"difference{end}"] for end in ENDS)
    sentences = [
        f"Largest difference, frozen minus closed loop: {points:+z.1f} points [{low:+z.1f}, "
        f"{high:+z.1f}], {worst['model']} {worst['prompt']} under {worst['condition']}, n = "
        f"{worst['n']} episodes."
    ]
    if not np.isnan(result.rank):
        models = f"{result.ranked} models and conditions"
        sentences.insert(0, f"Spearman's rank correlation of {models}: {result.rank:.2f}.")
    elif result.ranked < LEAST_RANKED:
        sentences.append(
            f"No rank correlation: {result.ranked} different models and conditions are too few; at "
            f"least {LEAST_RANKED} are needed."
        )
    return sentences


def _who(row: dict[Any, Any]) -> str:
    return str(Variant(*(row[name] for name in WHO)))


def _place(row: dict[Any, Any]) -> str:
    return f"{_who(row)}, {row['condition']}"
