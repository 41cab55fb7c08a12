"""Two finished runs on the same scenes with the same draws, as arrays of one layout."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.memory import uncollected
from harness.core.places import nameless
from harness.core.statistics import joined_clusters
from harness.dataset.select import pick
from harness.report.runs import parameters_apart
from harness.report.words import facts
from harness.runs.contradictions import sound
from harness.runs.difficulty import Pool
from harness.runs.folder import Run
from harness.runs.headline import headline_of
from harness.runs.metric_values import by_episode
from harness.runs.metrics import metrics_of
from harness.runs.percentiles import Decided
from harness.runs.records import Episode, FrozenScenes
from harness.runs.reliability import Judged
from harness.runs.settings import COMPARED
from harness.runs.sources import refuse_other_files
from harness.runs.success import Success
from harness.world.parameters import DIALS

# The order in which settings are listed; one that is not here comes after them.
ORDER = (
    "model",
    "prompt",
    "answer",
    "answers",
    "thinking",
    "image",
    "letters",
    "sums",
    "flip",
    "temperature",
    "sampling_seed",
    "helpers",
    "ties",
    "dtype",
    "latency",
)
NAMES = {**COMPARED, "helpers": None}  # settings, and the helpers' agents
SETTINGS = (*sorted(NAMES, key=lambda name: (*ORDER, name).index(name)), "identity", "versions")
# What conditions open, by the name of what each opens; of runs without a condition it is not there.
OPENED = ("channels", "networks", "schedules", "kept")


def where(run: Run) -> str:
    """Return a short description of a run's scenes: dataset and digest, or world and first seed."""
    world = run.manifest.world
    if isinstance(world, FrozenScenes):
        return f"{world.name} {world.sha256[:12]}"
    return f"{world.title} from layout seed {world.first_seed}"


@dataclass(frozen=True)
class Side:
    """Hold one of the two compared runs with its settings and its metrics as arrays.

    `settings` has the text of each setting by its dotted name, such as `model.name`. `values` has
    each metric by name for C conditions, S channel seeds and E episodes of the run, (C, S, E); NaN
    where unknown.
    """

    run: Run  # as it was read
    # those that may make a difference, by dotted name; None is left out
    settings: Mapping[str, str]
    values: Mapping[str, Floats]  # of each metric, (C, S, E) by the run's grid; NaN where unknown

    @cached_property
    def ends(self) -> Mapping[tuple[str, int, int], Episode]:
        """Return the record of each episode, by its condition's name, channel seed and number.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        return {(e.condition, e.seed, e.episode): e for e in self.run.episodes}

    @property
    def prompts(self) -> list[dict[str, Any]]:
        """Return what the run's record states of the prompts of the ego and of the first helper.

        A record has the keys `version`, `sha256` and `released`; if the ego's model answers for
        helpers, its prompt comes twice.
        """
        return [self.run.manifest.agent(place)["prompt"] for place in (0, 1)]


@dataclass(frozen=True)
class Pair:
    """Hold two runs that can be compared, and the conditions, seeds and episodes they share.

    `a` is the run that is compared with, `b` the one that is judged. `conditions` are names of sets
    of settings of the radio, of asking helpers and of fusing their messages, `seeds` channel seeds,
    and `episodes` episodes' numbers, ascending.
    """

    a: Side  # the one that is the base
    b: Side  # the one that is compared with it
    conditions: tuple[str, ...]  # names that both have, in the order of `a`
    seeds: tuple[int, ...]  # of the channel's draws, the same in both, ascending
    episodes: tuple[int, ...]  # numbers of the episodes that both have, ascending

    def values(self, side: Side, metric: str, condition: str) -> Floats:
        """Return a metric of one run under one condition, by E episodes and S seeds, (E, S).

        They are the episodes and seeds that both runs have; NaN where unknown. `side` is the run, A
        or B; `metric` and `condition` are names. A condition is a named set of settings of the
        radio, of asking helpers and of fusing their messages.
        """
        grid = side.run.grid
        seeds = [grid.seeds.index(seed) for seed in self.seeds]
        episodes = [grid.episodes.index(episode) for episode in self.episodes]
        of_condition = side.values[metric][grid.conditions.index(condition)]
        return np.asarray(of_condition[np.ix_(seeds, episodes)].T)

    @property
    def alone(self) -> dict[str, list[str]]:
        """Return the names of the conditions that only run `A` has, and those that only `B` has.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        a, b = self.a.run.conditions, self.b.run.conditions
        return {"A": [name for name in a if name not in b], "B": [n for n in b if n not in a]}

    @cached_property
    def left_out(self) -> dict[str, str]:
        """Return by which options run `A`, and run `B`, lacks episodes of the other.

        These are options that choose episodes by anything but chance, such as by what happens in
        them; a run that lacks none by them, or whose other run was chosen alike, is left out.
        """
        options = {}
        for name, run, other in (("A", self.a.run, self.b.run), ("B", self.b.run, self.a.run)):
            chosen = pick(run.manifest.world.selection, with_seeds=True)
            is_alike = chosen == pick(other.manifest.world.selection, with_seeds=True)
            if chosen and not is_alike and set(other.grid.episodes) - set(run.grid.episodes):
                options[name] = chosen
        return options

    @cached_property
    def clusters(self) -> Ints | None:
        """Return the number of each shared episode's cluster, (E,); None if each is of its own.

        A cluster is what layouts are cut from, such as a recording: intervals count clusters in
        place of episodes, which are in one cluster if either run says so.
        """
        names = []
        for side in (self.a, self.b):
            ends = [side.ends[self.conditions[0], self.seeds[0], each] for each in self.episodes]
            names.append([episode.cluster for episode in ends])
        return joined_clusters(names)

    def success_rule(self, condition: str) -> Success:
        """Return how success of the shared episodes is averaged, with the clusters of both runs.

        `condition` is the name of a set of settings of the radio, of asking helpers and of fusing
        their messages.
        """
        ends = [self.a.ends[condition, self.seeds[0], episode] for episode in self.episodes]
        rule = Success.of(ends, headline_of(self.a.run, self.b.run))
        return replace(rule, clusters=self.clusters)

    @cached_property
    def pool(self) -> Pool | None:
        """Return how hard the shared episodes are among all that they were sampled from.

        It corrects a difference of success for harder or easier episodes. How hard one is, is known
        from the success of rules that need no model. None if there are no more episodes than the
        shared ones, or if the runs disagree on them.
        """
        a = {layout.episode: layout for layout in self.a.run.layouts}
        b = {layout.episode: layout for layout in self.b.run.layouts}
        if any(b.get(episode, layout) != layout for episode, layout in a.items()):
            return None  # of one dataset both say the same, unless somebody changed a file
        both = {*(a or self.a.run.grid.episodes)} & {*(b or self.b.run.grid.episodes)}
        layouts = [layout for episode, layout in {**a, **b}.items() if episode in both]
        return Pool.of(layouts, self.episodes) if len(layouts) > len(self.episodes) else None

    def judged(self, side: Side, condition: str) -> Judged:
        """Return how sure and how right the shared decisions are, for metrics of calibration.

        They are the decisions of the run `side` under one condition with exactly one optimal
        action: one after which success is still possible, where it is possible at all.
        `Judged.episode` holds each one's index in `self.episodes`. A condition is a named set of
        settings of the radio, of asking helpers and of fusing their messages.
        """
        rows, place = self._rows(side, condition)
        policy = side.run.decisions.of_actions("fused")[rows]
        safe = side.run.decisions.of_actions("safe")[rows]
        return Judged.of(policy, safe == 1.0, place)

    def latencies(self, side: Side, condition: str) -> list[Decided]:
        """Return how long the shared decisions of a run take, for each channel seed.

        An item is a pair of arrays (n,): each decision's episode, as an index in `episodes`, and
        its latency, ms. `side` is the run, and `condition` the name of a set of settings of the
        radio, of asking helpers and of fusing their messages.
        """
        rows, place = self._rows(side, condition)
        seed = side.run.decisions["seed"][rows]
        latency_ms = side.run.decisions["latency_ms"][rows]
        return [(place[seed == s], latency_ms[seed == s]) for s in self.seeds]

    def _rows(self, side: Side, condition: str) -> tuple[Ints, Ints]:
        """Return the rows of a condition's decisions in `episodes`,
        and the place of each there, (n,).
        """
        decisions = side.run.decisions
        names, episode = side.run.conditions, decisions.whole("episode")
        of_condition = decisions.codes("condition", names) == names.index(condition)
        rows = np.flatnonzero(of_condition & np.isin(episode, self.episodes))
        return rows, np.searchsorted(self.episodes, episode[rows]).astype(np.int64)


@uncollected()
def pair(a: Path, b: Path) -> Pair:
    """Read two run folders, `a` and `b`, and pair the runs for a comparison.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.

    Raises:
        UserError: a folder is no finished run or contradicts itself, or the two runs differ in
            kind, scenes or seeds, or have no condition or episode in common.
    """
    first, second = sound(a), sound(b)
    both = f"{printable(a)} and {printable(b)}"
    if first.world != second.world:
        raise UserError(
            f"{both}: one was made by `harness eval` and one by `harness drive`; give two of a "
            "kind, or see `harness study fidelity`"
        )
    side_a, side_b = _side(first), _side(second)
    if first.manifest.world.pinned != second.manifest.world.pinned:
        scenes = " and ".join(printable(where(run), 60) for run in (first, second))
        scenes += parameters_apart(first, second)
        raise UserError(f"{both} are not of the same scenes ({scenes}); make both on the same")
    seeds_a, seeds_b = sorted(first.manifest.seeds), sorted(second.manifest.seeds)
    if seeds_a != seeds_b:
        seeds = " and ".join(printable(each, 40) for each in (seeds_a, seeds_b))
        raise UserError(f"{both} have different seeds ({seeds}); make both with the same --seeds")
    conditions = tuple(name for name in first.conditions if name in second.conditions)
    if not conditions:
        names = " and ".join(printable(", ".join(run.conditions), 60) for run in (first, second))
        raise UserError(
            f"{both} have no condition in common ({names}); make both with the same --condition"
        )
    episodes = set(first.grid.episodes) & set(second.grid.episodes)
    if not episodes:
        raise UserError(f"{both} have no episode in common; make both on the same episodes")
    return Pair(side_a, side_b, conditions, tuple(seeds_a), tuple(sorted(episodes)))


def _side(run: Run) -> Side:
    manifest = msgspec.json.decode(msgspec.json.encode(run.manifest.as_file()))
    values = {**manifest["settings"], **manifest}  # a model, say, as it was opened
    record = {name: values[name] for name in SETTINGS}
    if run.world == "closed-loop":
        parameters = manifest["world"]["scenario"]["parameters"]
        record["scenario"] = {key: parameters[key] for key in DIALS if key in parameters}
    opened = run.manifest
    radios = {
        name: {"model": radio.model, **radio.parameters} for name, radio in opened.channels.items()
    }
    record |= zip(OPENED, (radios, opened.networks, opened.schedules, opened.kept), strict=True)
    record = {**opened.beside, **record}
    # Through the class, which gives a setting that the run does not know the value it had then.
    conditions = manifest["conditions"]
    try:
        points = [OperatingPoint.from_dict(condition).record() for condition in conditions]
    except UserError as error:
        refuse_other_files(run)
        raise UserError(f"{printable(run.path)}: {error}") from None
    record["condition"] = {point["name"]: point for point in points}
    settings = {name: str(value) for name, value in facts(nameless(record)) if value is not None}
    metrics = by_episode(metrics_of(run.world), run.grid, run.decisions, run.episodes)
    return Side(run, settings, metrics)
