"""What a message should hold: every content of messages at every point, and what it comes to.

Every content is played at every point from stored answers, with the same draws; `nothing` is an ego
that asks nobody. A model's runs on several families of scenes are averaged with equal weight, and
differences to intents are paired by episode within each family.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs

from harness.coordination.contents import CONTENTS, INTENT, OF_HELPERS, TRUTH
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.scheduling import NEVER
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.formats import SUITE
from harness.core.progress import Progress
from harness.core.statistics import Estimate, mean_of
from harness.evaluate.dry_run import lacking
from harness.evaluate.walk import Decided
from harness.report.suite import MEAN
from harness.runs.leading import BALANCED, IN_WORDS, SUCCESS
from harness.runs.metrics import LATENCY, entry, over_episodes
from harness.runs.success import Success, mean_difference, p_of_mean
from harness.runs.suite import contents_of
from harness.studies.axes import Setting, axis_of, described, grid
from harness.studies.play import by_episode, metric_columns
from harness.studies.replayed_run import ReplayedRun, counted
from harness.studies.study import corrected, refuse_other
from harness.studies.sweep import point_of, settings
from harness.world.lookouts import radios
from harness.world.parameters import frames

NOTHING = "nothing"
PLAYED = (NOTHING, *OF_HELPERS)
BITS, LATE, OFF_LAG = "bits_per_episode", "deadline_miss_rate", "off_lag_rate"
METRICS = (BITS, LATENCY, LATE, OFF_LAG, "messages_per_episode", "trigger_rate")
BASE, RADIO = "6g:encoding=etsi", "mode2:encoding=etsi"
# What is varied without --over: a condition, an axis and its values.
USUAL = (
    (BASE, "tau_nats", "0,0.4,0.7,0.9,1.05"),
    (BASE, "max_helpers", "1,2,3"),
    (BASE, "loss", "0,0.1,0.2,0.4,0.6"),
    (BASE, "latency", "0,25,50,60,100"),
    (RADIO, "density_per_km", "50,100,200,400"),
)
SAFE, HEARD = -1, -2  # in place of a number of witnesses

Place = tuple[OperatingPoint, int]  # of an outcome: the operating point, and the number of vehicles


class Panel(NamedTuple):
    """One axis in one condition; without an axis, the condition as it is."""

    name: str
    axis: str  # empty without one
    settings: tuple[Setting, ...]  # its grid points, whatever a message holds


@dataclass(frozen=True)
class Model:
    """The runs of one model."""

    name: str
    runs: Mapping[str, ReplayedRun]  # by family of scenes
    left_out: Mapping[str, str]  # contents that its agents cannot play, and why

    @property
    def contents(self) -> list[str]:
        """The contents that it plays."""
        return [content for content in PLAYED if content not in self.left_out]


@dataclass(frozen=True)
class Outcome:
    """What a model's runs came to at one point."""

    families: Mapping[str, Mapping[str, Floats]]  # metrics by family, each (S, E)
    counting: Mapping[str, Success]  # how success counts in each family: alike in all

    @property
    def lead(self) -> str:
        """The metric by which it is read."""
        return next(iter(self.counting.values())).metric

    @property
    def leading(self) -> Estimate:
        """What leads, as the mean over families."""
        return self.estimate(self.lead)

    def estimate(self, metric: str, family: str = MEAN) -> Estimate:
        """Return a metric of a family, or its mean over families."""

        def of(name: str) -> Estimate:
            each = self.families[name]
            if metric == BALANCED:
                return self.counting[name].estimate(each[SUCCESS])
            return over_episodes(metric, each[metric])

        return mean_of([*map(of, self._of(family))])

    def over(
        self, other: "Outcome", family: str = MEAN, level: float = 0.95, metric: str = ""
    ) -> Estimate:
        """Return success less another outcome's, paired by episode; plain if `metric` is."""
        return mean_difference([*self._pairs(other, family, metric)], level)

    def p_over(self, other: "Outcome") -> float | None:
        """Return the p-value of no such difference in the mean over families."""
        return p_of_mean([*self._pairs(other, MEAN)])

    def _pairs(
        self, other: "Outcome", family: str, metric: str = ""
    ) -> Iterator[tuple[Success, Floats, Floats]]:
        for name in self._of(family):
            how = self.counting[name].plain if metric == SUCCESS else self.counting[name]
            yield how, self.families[name][SUCCESS], other.families[name][SUCCESS]

    def pooled(self, groups: Mapping[str, Bools]) -> Floats:
        """Return success of the episodes of all families that are in a group, (S, n)."""
        return np.hstack(
            [each[SUCCESS][:, groups[family]] for family, each in self.families.items()]
        )

    def _of(self, family: str) -> list[str]:
        return list(self.families) if family == MEAN else [family]


@dataclass(frozen=True)
class Result:
    """All points of one model."""

    model: Model
    panels: Sequence[Panel]
    outcomes: Mapping[Place, Outcome]

    def at(self, setting: Setting, content: str) -> Outcome:
        """Return the outcome of a content at a grid point."""
        return self.outcomes[place(setting, content)]

    @property
    def base(self) -> Setting:
        """The first condition as it is."""
        return self.panels[0].settings[0]

    @property
    def points(self) -> list[Setting]:
        """Each different grid point once."""
        return distinct(self.panels)

    @property
    def others(self) -> list[str]:
        """The contents that are compared with intents."""
        return [content for content in self.model.contents if content != INTENT]

    @property
    def sent(self) -> list[str]:
        """The contents beside intents that a message can hold."""
        return [
            content
            for content in self.others
            if content != NOTHING and CONTENTS[content].graph != TRUTH
        ]

    @cached_property
    def _p(self) -> dict[Place, float | None]:
        pairs = [(setting, content) for setting in self.points for content in self.others]
        raw = [
            self.at(setting, content).p_over(self.at(setting, INTENT)) for setting, content in pairs
        ]
        return dict(zip([place(*pair) for pair in pairs], corrected(raw), strict=True))

    def p(self, setting: Setting, content: str) -> float | None:
        """Return the p of a content against intents,
        by Holm's method for all of the model; of these None.
        """
        return self._p.get(place(setting, content))

    @property
    def lead(self) -> str:
        """The metric by which success is read."""
        return self.at(self.base, INTENT).lead

    @property
    def words(self) -> str:
        """The same for people."""
        return IN_WORDS[self.lead]

    @property
    def successes(self) -> tuple[str, ...]:
        """What leads, then what it is the mean of."""
        return self.lead, *entry(self.lead).halves

    @property
    def families(self) -> list[str]:
        """The families, and their mean where there are several."""
        names = list(self.model.runs)
        return [*names, MEAN] if len(names) > 1 else names


def holding(point: OperatingPoint, content: str) -> OperatingPoint:
    """Return the operating point with this content."""
    if content == NOTHING:
        return point.changed(content=INTENT, schedule=NEVER, threshold=None)
    return point.changed(content=content)


def place(setting: Setting, content: str) -> Place:
    """Return what decides an outcome: the operating point with this content,
    and the number of vehicles.
    """
    return holding(setting.point, content), setting.vehicles


def distinct(panels: Sequence[Panel]) -> list[Setting]:
    """Return each different grid point once, in order."""
    every = [setting for panel in panels for setting in panel.settings]
    return list({place(setting, INTENT): setting for setting in reversed(every)}.values())[::-1]


def folders(path: Path) -> list[Path]:
    """Return the folders of a suite's runs, or a run's own."""
    if (path / SUITE).is_file():
        return [path / name for name in contents_of(path).families.values()]
    return [path]


def models(given: Sequence[Sequence[ReplayedRun]], panels: Sequence[Panel]) -> list[Model]:
    """Return the models of some runs, each with the contents that it can play in these panels.

    Args:
        given: the runs of a suite together, which are of one model, or a run alone.
        panels: what is played.

    Raises:
        UserError: two runs of a model are on the same family, or a model can play no intents.
    """
    by_model: dict[str, dict[str, ReplayedRun]] = {}
    for runs in given:
        variants = [run.run.manifest.variant for run in runs]
        prompts = " and ".join(dict.fromkeys(variant.prompt for variant in variants))
        name = str(structs.replace(variants[0], prompt=prompts))
        theirs = by_model.setdefault(name, {})
        for run in runs:
            family = run.dataset.scenario.name
            if family in theirs:
                raise UserError(
                    f"{printable(run.run.path)} and {printable(theirs[family].run.path)} are both "
                    f"{printable(name)} on {printable(family)}; give one of them"
                )
            theirs[family] = run
    result = []
    for name, theirs in by_model.items():
        left_out = dict(
            _unable(list(theirs.values()), [setting.point for setting in distinct(panels)])
        )
        if INTENT in left_out:
            raise UserError(f"{printable(name)}: {left_out[INTENT]}")
        result.append(Model(name, theirs, left_out))
    return result


def _unable(
    runs: Sequence[ReplayedRun], points: Sequence[OperatingPoint]
) -> Iterator[tuple[str, str]]:
    """Yield the contents that some of these runs' agents cannot play, and why."""
    for content in PLAYED:
        try:
            held = tuple(holding(point, content) for point in points)
            for run in runs:
                for point in held:
                    replace(run.spec, points=(point,))
        except UserError as error:
            yield content, str(error)


def panels_of(
    runs: Sequence[ReplayedRun],
    conditions: Sequence[str],
    over: Sequence[str],
    grids: Sequence[str],
) -> list[Panel]:
    """Return the conditions as they are, and each axis in each of them;
    the usual ones if none is given.

    Raises UserError as `sweep.settings` does, or if there are more grids than axes.
    """
    if len(grids) > len(over):
        raise UserError(
            f"--grid: {len(grids)} given for {len(over)} of --over; give one for each, in order"
        )
    if conditions or over:
        values = [*grids, *[None] * (len(over) - len(grids))]
        conditions = conditions or [BASE]
        varied = [
            (c, axis, text) for c in conditions for axis, text in zip(over, values, strict=True)
        ]
    else:
        varied = list(USUAL)
        conditions = [BASE]
    vehicles = min(run.vehicles for run in runs)
    panels = [Panel(c, "", (Setting(c, point_of(runs, c), vehicles),)) for c in conditions]
    for condition, name, text in varied:
        axis = axis_of(name)
        grid_points = settings(runs, [axis], [grid(axis, text)], [condition])
        panels.append(Panel(f"{condition} over {name}", name, grid_points))
    return panels


def asked_at_most(model: Model, panels: Sequence[Panel]) -> dict[str, dict[str, int]]:
    """Return how many questions each run may lack, by family and role.

    They are about the decision points that the run or a reference driver comes to.
    """
    points = tuple(
        {
            holding(setting.point, content)
            for panel in panels
            for setting in panel.settings
            for content in model.contents
        }
    )
    return {
        family: lacking(
            replace(run.spec, points=points),
            run.dataset,
            sorted({*run.dataset.courses(), *run.run.decisions.scenes}),
            run.answers,
        )
        for family, run in model.runs.items()
    }


def manifest_of(
    swarms: Sequence[Model], panels: Sequence[Panel], seeds: Sequence[int]
) -> dict[str, Any]:
    """Return what a study is made of."""
    return {
        "sources": [run.manifest() for model in swarms for run in model.runs.values()],
        "contents": list(PLAYED),
        "seeds": list(seeds),
        "panels": described({panel.name: panel.settings for panel in panels}),
    }


def run_contents(
    swarms: Sequence[Model],
    panels: Sequence[Panel],
    seeds: Sequence[int],
    out: Path,
    progress: Progress,
) -> list[Result]:
    """Play every content at every grid point with every model's runs.

    Raises:
        UserError: the folder holds another study.
        Unanswered: too many questions got no answer; the runs keep all others.
    """
    refuse_other(out, "contents", manifest_of(swarms, panels, seeds))
    points = distinct(panels)
    progress.more(sum(len(model.contents) * len(model.runs) * len(points) for model in swarms))
    results = [_played(model, panels, points, seeds, progress) for model in swarms]
    for run in (run for model in swarms for run in model.runs.values()):
        run.settle()
    return results


def _played(
    model: Model,
    panels: Sequence[Panel],
    points: Sequence[Setting],
    seeds: Sequence[int],
    progress: Progress,
) -> Result:
    every = [
        replace(setting, point=holding(setting.point, content))
        for content in model.contents
        for setting in points
    ]
    by_family: dict[Place, dict[str, Mapping[str, Floats]]] = {
        (s.point, s.vehicles): {} for s in every
    }
    for family, run in model.runs.items():
        p = run.dataset.scenario.parameters

        def read(
            part: Decided[Any], lag: int = p.lag_frames, hz: int = p.simulation_hz
        ) -> dict[str, Floats]:
            values = metric_columns(part)
            seconds, at = np.unique(part.result.latency_s, return_inverse=True)
            off = np.array(
                [frames(each, hz) != lag if each == each else np.nan for each in seconds.tolist()]
            )
            return {**values, "off_lag": off[at]}

        for setting, [walk] in zip(every, run.walked(every, seeds, read), strict=True):
            metrics = {**walk.ends, **by_episode(walk, METRICS)}
            by_family[setting.point, setting.vehicles][family] = metrics
            progress(1)
    by_run = counted(list(model.runs.values()))
    counting = {family: by_run[run] for family, run in model.runs.items()}
    return Result(model, panels, {key: Outcome(of, counting) for key, of in by_family.items()})


def witnesses(run: ReplayedRun) -> Ints:
    """Return how many helpers have the danger in sight at the first decision of each episode, (E,).

    `SAFE` without a danger, `HEARD` where it has a radio: its beacons tell of it, whoever sees it.
    """
    forest, scenario = run.dataset.forest, run.dataset.scenario
    counts = []
    for scene in run.dataset.scenes([forest.ids[n] for n in forest.root.tolist()]):
        danger = scene.record.danger
        seen = [
            any(node.id == danger.vehicle for node in scene.graphs[v].nodes)
            for v in scene.viewers[1:]
        ]
        heard = radios(scenario, scene.state.episode_seed, danger.sector)["danger_radio"]
        counts.append(SAFE if danger.vehicle is None else HEARD if heard else sum(seen))
    return np.array(counts)


def groups(model: Model) -> dict[str, dict[str, Bools]]:
    """Return by name which episodes of each family, (E,), are in each group:
    by who sees the danger.
    """
    counts = {family: witnesses(run) for family, run in model.runs.items()}
    most = max(int(each.max()) for each in counts.values())
    numbers = {"no danger": SAFE, **{f"a danger, seen by {n}": n for n in range(most + 1)}}
    numbers["a danger with a radio"] = HEARD
    named = {
        name: {family: each == n for family, each in counts.items()} for name, n in numbers.items()
    } | {"any danger": {family: each != SAFE for family, each in counts.items()}}
    return {name: within for name, within in named.items() if any(map(np.any, within.values()))}
