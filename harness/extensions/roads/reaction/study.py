"""What it is worth that recorded others react: how every course ends in both worlds.

A course is a sequence of the ego's actions, one for each decision. Where others only replay what
they were recorded to do, they drive into an ego that is slower than the recorded driver was.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Bools, Ints, Texts
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.statistics import Estimate, rate_interval
from harness.core.versions import versions
from harness.dataset.load import Dataset
from harness.extensions.roads.family import PREFIX
from harness.extensions.roads.reaction.stopping import could_stop
from harness.extensions.roads.replay import HARDEST_MPS2
from harness.report.document import Table
from harness.report.drawing.colours import COLOURS

if TYPE_CHECKING:
    import pandas as pd

    from harness.studies.figures.described import Draws
    from harness.studies.study import Study

REACT = "react"  # the parameter in which the two datasets differ
CAREFUL = "SLOWER"
WORLDS = ("replay", "react")  # columns of a table end so
LABELS = {"replay": "others only replay", "react": "others react"}
COUNTED = ("collisions", "struck", "other_crashes")  # of each world
HEADS = ("crashes", "struck by another", "who could stop", "crashes of others")
AVOIDABLE = "could_stop_react"  # column of strikes with reaction that braking avoids
# columns with intervals, and what is counted for each
RATES = {
    "otherwise": "otherwise",
    "struck_rate_replay": "struck_replay",
    "struck_rate_react": "struck_react",
}
# Takes the step, which courses go on, (k,), and their decision points, (k,); returns actions, (k,).
Chosen = Callable[[int, Ints, Ints], Ints]


@dataclass(frozen=True)
class Ends:
    """Say how n courses end in one world.

    A course is a sequence of the ego's actions.
    """

    results: Texts  # such as `cleared`, (n,)
    collisions: Bools  # whether the ego collides, (n,)
    struck: Bools  # whether another's front makes that collision, (n,)
    could_stop: Bools  # whether that other reacts, and could have stopped, (n,)
    other_crashes: Ints  # vehicles that crash without the ego on the way, (n,)


@dataclass(frozen=True)
class Reaction:
    """Hold how courses end with others that react, and with others that replay.

    A row has `courses`, `n` layouts, the share `otherwise` of courses that have another result, and
    of each world (`_replay`, `_react`) the numbers of `collisions`, of those `struck` by another,
    of `other_crashes`, and the share `struck_rate` of courses that are struck. `could_stop_react`
    is the number of those struck with reaction by another that could have stopped. Shares are from
    0 to 1, with `_low` and `_high`.
    """

    courses: "pd.DataFrame"  # all courses, a row a number of SLOWER in them (`slower`), then `all`
    drivers: "pd.DataFrame"  # the courses of the reference drivers, a row a `driver`
    scenes: int  # what the layouts are cut from, over which intervals are


def manifest_of(with_reaction: Dataset, without_reaction: Dataset) -> dict[str, Any]:
    """Return what a study of two datasets is made of, for its manifest.

    Raises UserError unless these are of the same layouts of one recording, and differ in whether
    others react alone.
    """
    for dataset, reacts in ((with_reaction, True), (without_reaction, False)):
        manifest = dataset.manifest
        if not manifest.scenario.startswith(PREFIX) or REACT not in manifest.parameters:
            raise UserError(
                f"{printable(dataset.path)} is of {printable(manifest.scenario, 80)}, which is no "
                "recording; give two datasets of one recording"
            )
        if manifest.parameters[REACT] is not reacts:
            raise UserError(
                f"{printable(dataset.path)} has {REACT}={str(not reacts).lower()}; give first the "
                f"dataset whose others react, then one built with {REACT}=false"
            )
    if unlike := list(_unlike(with_reaction, without_reaction)):
        one, other = printable(with_reaction.path), printable(without_reaction.path)
        raise UserError(
            f"{one} and {other} differ in {', '.join(unlike)}; give datasets that differ in "
            f"{REACT} alone"
        )
    sources = []
    for each in (with_reaction, without_reaction):
        sources.append({"name": each.name, "dataset_sha256": each.sha256})
    return {"sources": sources, "versions": versions()}


def _unlike(a: Dataset, b: Dataset) -> Iterator[str]:
    """Yield in what two datasets differ beside their reaction."""
    if a.manifest.scenario != b.manifest.scenario:
        yield "recording"
    if a.seeds != b.seeds:
        yield "layout seeds"
    of_a, of_b = a.manifest.parameters, b.manifest.parameters
    for name in sorted(of_a.keys() | of_b.keys()):
        if name != REACT and of_a.get(name) != of_b.get(name):
            yield printable(name)


def reaction(
    with_reaction: Dataset, without_reaction: Dataset, progress: Callable[[int], None]
) -> Reaction:
    """Follow all courses, and those of the reference drivers, in the trees of two datasets.

    The datasets, of the same layouts, have others that react and others that replay. `progress` is
    called with the number of layouts just done.
    """
    import pandas as pd

    worlds = [World(without_reaction), World(with_reaction)]
    actions, clusters = with_reaction.actions, with_reaction.clusters
    decisions = with_reaction.scenario.parameters.decisions
    sequences = np.indices((len(actions),) * decisions).reshape(decisions, -1).T
    slower = (sequences == actions.index(CAREFUL)).sum(axis=1)
    by_layout = []
    for layout in range(len(with_reaction.episodes)):
        pair = [_of_sequences(world, layout, sequences) for world in worlds]
        by_layout.append(_tally(pair, slower))
        progress(1)
    tally = {}
    for name in by_layout[0]:
        tally[name] = np.stack([of_layout[name] for of_layout in by_layout])

    rows = []
    for k in range(decisions + 1):
        of_k = {name: counts[:, k] for name, counts in tally.items()}
        rows.append({"slower": str(k), **_row(of_k, clusters)})
    whole = {name: counts.sum(axis=1) for name, counts in tally.items()}
    rows.append({"slower": "all", **_row(whole, clusters)})
    drivers = []
    for name in with_reaction.forest.drivers:
        pair = [_of_driver(world, name) for world in worlds]
        of_driver = _tally(pair, np.arange(len(with_reaction.episodes)))
        drivers.append({"driver": name, **_row(of_driver, clusters)})
    scenes = len(by_layout) if clusters is None else len(np.unique(clusters))
    return Reaction(pd.DataFrame(rows), pd.DataFrame(drivers), scenes)


class World:
    """Follow courses through the decision trees of a dataset, in which others react or replay."""

    def __init__(self, dataset: Dataset) -> None:
        """Read how the edges of the trees end."""
        self.dataset, self.forest = dataset, dataset.forest
        ends = [edge.end for edge in self.forest.edges]
        self.result = np.array([end.result if end else "" for end in ends])
        self.struck = np.array([end is not None and end.striker == "other" for end in ends])
        self.crashes = np.array([edge.other_crashes for edge in self.forest.edges])
        self._could_stop: dict[int, bool] = {}  # by the index of an edge that ends in a strike

    def ends(self, first: Ints, chosen: Chosen) -> Ends:
        """Return how n courses end that begin at some decision points, (n,).

        `chosen` says which actions they take.
        """
        at, courses = first.copy(), np.arange(len(first))
        last, crashes, step = np.full(len(first), -1), np.zeros(len(first), dtype=np.int64), 0
        taken: list[list[int]] = [[] for _ in courses]
        while courses.size:
            action = chosen(step, courses, at[courses])
            for course, number in zip(courses.tolist(), action.tolist(), strict=True):
                taken[course].append(number)
            edge = self.forest.edge[at[courses], action]
            last[courses] = edge
            crashes[courses] += self.crashes[edge]
            at[courses] = self.forest.child[at[courses], action]
            courses, step = np.flatnonzero(at >= 0), step + 1
        results, could_stop = self.result[last], np.zeros(len(last), dtype=bool)
        if self.dataset.manifest.parameters[REACT]:
            for course in np.flatnonzero(self.struck[last]).tolist():
                layout = int(self.forest.tree[first[course]])
                could_stop[course] = self.could_stop(layout, taken[course], int(last[course]))
        return Ends(results, results == "collision", self.struck[last], could_stop, crashes)

    def could_stop(self, layout: int, taken: Sequence[int], edge: int) -> bool:
        """Return whether who strikes the ego at the end of a layout's course could have stopped.

        `taken` are the numbers of the course's actions, and `edge` is the index of its last edge.
        """
        if edge not in self._could_stop:
            actions = [self.forest.actions[number] for number in taken]
            seed, striker = int(self.forest.seeds[layout]), self.forest.end(edge).partner or ""
            self._could_stop[edge] = could_stop(self.dataset.scenario, seed, actions, striker)
        return self._could_stop[edge]


def _of_sequences(world: World, layout: int, sequences: Ints) -> Ends:
    """Return how all courses of a layout end; `sequences` has their actions, (n, decisions)."""
    first = np.full(len(sequences), world.forest.root[layout])
    return world.ends(first, lambda step, courses, _: sequences[courses, step])


def _of_driver(world: World, name: str) -> Ends:
    """Return how a reference driver's courses end, one of each layout."""
    chosen = world.forest.drivers[name]
    return world.ends(world.forest.root, lambda _, courses, points: chosen[points])


def _tally(pair: Sequence[Ends], groups: Ints) -> dict[str, Ints]:
    """Count what happens to n courses in each of k groups, (k,) by name.

    `pair` is how they end without reaction and with it, and `groups` the number of each course's
    group, (n,).
    """
    replay, react = pair
    counts = {
        "courses": np.bincount(groups),
        "otherwise": np.bincount(groups, replay.results != react.results),
    }
    for world, ends in zip(WORLDS, pair, strict=True):
        for name in COUNTED:
            counts[f"{name}_{world}"] = np.bincount(groups, getattr(ends, name))
    counts[AVOIDABLE] = np.bincount(groups, react.could_stop)
    return {name: each.astype(np.int64) for name, each in counts.items()}


def _row(counts: Mapping[str, Ints], clusters: Ints | None) -> dict[str, Any]:
    """Return a row of `Reaction`'s tables from counts of each of E layouts, (E,)."""
    row: dict[str, Any] = {"courses": int(counts["courses"].sum()), "n": len(counts["courses"])}
    for name, count in RATES.items():
        rate = rate_interval(counts[count] / counts["courses"], clusters)
        row |= {name: rate.value, f"{name}_low": rate.low, f"{name}_high": rate.high}
    for name in COUNTED:
        row |= {f"{name}_{world}": int(counts[f"{name}_{world}"].sum()) for world in WORLDS}
    return row | {AVOIDABLE: int(counts[AVOIDABLE].sum())}


def reaction_study(result: Reaction, manifest: Mapping[str, Any]) -> "Study":
    """Return the study (tables, figure and sentences) on what others' reaction is worth.

    `manifest` is what it was made of (`manifest_of`).
    """
    from harness.studies.study import Study, percent

    def table(title: str, head: str, rows: "pd.DataFrame", total: bool) -> Table:
        cells = []
        for row in rows.to_dict("records"):
            share = percent(row, "otherwise", "otherwise_low", "otherwise_high")
            counts = [f"{row[f'{name}_replay']} / {row[f'{name}_react']}" for name in COUNTED]
            counts.insert(2, str(row[AVOIDABLE]))
            cells.append((row[head], str(row["courses"]), share, *counts, str(row["n"])))
        heads = (head, "courses", "otherwise %", *HEADS, "n")
        return Table(title, heads, cells, terminal=(0, 1, 2, 3, 4, 5), total=total)

    whole = result.courses.to_dict("records")[-1]
    share = percent(whole, "otherwise", "otherwise_low", "otherwise_high")
    over = amount(result.scenes, "scene")
    return Study(
        "reaction",
        "Recorded others that react, and that only replay",
        [
            f"{share} % of {whole['courses']} courses end otherwise if others only replay.",
            f"Struck by another: {whole['struck_replay']} of {whole['collisions_replay']} crashes "
            f"without reaction, {whole['struck_react']} of {whole['collisions_react']} with it; "
            f"crashes of others in all: {whole['other_crashes_replay']} and "
            f"{whole['other_crashes_react']}.",
            f"With reaction {whole[AVOIDABLE]} of {whole['collisions_react']} crashes are of "
            "another that could have stopped.",
        ],
        [
            "A course is a sequence of the ego's actions, one for each decision, and every course "
            "of every layout is played in both worlds. A course ends otherwise if it has another "
            "result: at the goal, in a collision, off the road, or too late. A number of crashes "
            "is that of courses, and of others that of vehicles; a vehicle that crashes in one "
            "course may crash in all.",
            "n is the number of layouts, and crashes are counted without reaction / with it; "
            f"95 % intervals are over the {over} that layouts are cut from. All is conditional on "
            "the moments of this recording, and on the model by which others react: they brake for "
            "whoever is off the recording, by the Intelligent Driver Model. Who strikes the ego "
            f"could have stopped if braking by {HARDEST_MPS2:g} m/s² avoids that crash, from the "
            "first frame on in which the ego stands in its way; the course is played again so.",
        ],
        [
            table("All courses, by how often the ego slows down", "slower", result.courses, True),
            table("Courses of the reference drivers", "driver", result.drivers, False),
        ],
        {"courses": result.courses, "drivers": result.drivers},
        manifest,
        {"courses": result.courses, "drivers": result.drivers},
        lambda draws: {"reaction": _struck(draws, result)},
    )


def _struck(draws: "Draws[Any]", result: Reaction) -> Any:
    """Draw how often others strike the ego, by how often it slows down."""
    from harness.studies.figures.described import Rows

    rows = result.courses.iloc[:-1].to_dict("records")
    series: dict[str, list[Estimate | None]] = {}
    for world, label in LABELS.items():
        series[label] = []
        for row in rows:
            value, low, high = (row[f"struck_rate_{world}{end}"] for end in ("", "_low", "_high"))
            series[label].append(Estimate(value, low, high, row["n"], 0))
    names = [str(row["slower"]) for row in rows]
    panel = Rows("courses struck by another, %, by decisions that slow down", names, series)
    return draws.intervals([panel], dict(zip(series, COLOURS, strict=False)))
