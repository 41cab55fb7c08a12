"""What a message should hold: every content of messages at every point, and what it comes to.

Every content is played at every point from stored answers, with the same draws; `nothing` is an ego
that asks nobody. A model's runs on several families of scenes are averaged with equal weight, and
differences to intents are paired by episode within each family.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs

from harness.coordination.contents import CONTENTS, INTENT, TRUTH
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.scheduling import NEVER
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.formats import SUITE
from harness.core.progress import Progress
from harness.core.statistics import Estimate
from harness.evaluate.dry_run import lacking
from harness.evaluate.walk import Decided
from harness.report.suite import MEAN
from harness.runs.alike import different, setup
from harness.runs.estimates import over_episodes
from harness.runs.headline import BALANCED, IN_WORDS, SUCCESS
from harness.runs.metric_names import LATENCY
from harness.runs.metrics import entry
from harness.runs.success import Success, clusters_of, mean_difference, of_families, p_of_mean
from harness.runs.suite import contents_of
from harness.studies.axes import Setting, axis_of, described, grid
from harness.studies.play import by_episode, metric_columns
from harness.studies.replayed_run import ReplayedRun, counted
from harness.studies.study import corrected, refuse_other
from harness.studies.sweep import distinct_names, point_of, settings
from harness.world.lookouts import radios
from harness.world.parameters import Parameters, frames

NOTHING = "nothing"
PLAYED = (NOTHING, INTENT, "text", "objects", "both", "oracle")
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
    """Describe what a study varies in one condition: one setting, its axis, with its values.

    A condition is a named set of settings of radio, asking and fusion. A grid point is the
    condition with one value of the axis, and a number of vehicles; without an axis, the condition
    is played as it is.
    """

    name: str  # such as `6g:encoding=etsi over loss`
    axis: str  # the setting that is varied; empty without one
    settings: tuple[Setting, ...]  # its grid points, the same for every content


@dataclass(frozen=True)
class Model:
    """Hold the runs of one model, by family (the scenario's name), that a study plays again.

    The study varies what messages between vehicles hold: `intent` (probabilities of actions),
    `objects`, `both` and so on. It uses the runs' stored answers; only what they lack is asked.
    """

    name: str  # model, prompts and answer mode
    runs: Mapping[str, ReplayedRun]  # its runs by family, the scenario's name
    left_out: Mapping[str, str]  # contents that its agents cannot play, and why

    @property
    def contents(self) -> list[str]:
        """Return what messages may hold in this model's runs, such as `objects`.

        `intent` is a vehicle's probabilities of actions; `nothing` stands for an ego that asks
        nobody, and `oracle` for the whole truth.
        """
        return [content for content in PLAYED if content not in self.left_out]


@dataclass(frozen=True)
class Outcome:
    """Hold how well the ego does with one content of messages under one set of settings.

    The content is what messages hold, such as `objects`; the settings are those of radio, asking
    and fusion, with one value changed. A family is the scenes of one scenario.
    """

    # values by family and metric, such as `success_rate`, (S, E) each
    families: Mapping[str, Mapping[str, Floats]]
    success_rules: Mapping[str, Success]  # of each family; the metric is the same in all

    @property
    def headline_metric(self) -> str:
        """Return the name of the metric of success that is shown first, plain or balanced.

        Balanced success is the mean over episodes with a danger (a vehicle that the ego would meet)
        and without.
        """
        return next(iter(self.success_rules.values())).metric

    @property
    def success(self) -> Estimate:
        """Return the share of successful episodes, plain or balanced, as a mean over scenarios.

        Balanced is the mean over episodes with a danger (a vehicle that the ego would meet) and
        without.
        """
        return self.estimate(self.headline_metric)

    def estimate(self, metric: str, family: str = MEAN) -> Estimate:
        """Return the mean of a metric over the episodes of a scenario, with an interval.

        `metric` is its name, such as `success_rate`, and `family` the scenario's name; by default
        it is the mean over all scenarios.
        """
        estimates = []
        for name in self._of(family):
            values, rule = self.families[name], self.success_rules[name]
            if metric == BALANCED:
                estimates.append(rule.estimate(values[SUCCESS]))
            else:
                estimates.append(over_episodes(metric, values[metric], rule.clusters))
        return of_families(estimates, [self.success_rules[name] for name in self._of(family)])

    def over(
        self, other: "Outcome", family: str = MEAN, level: float = 0.95, metric: str = ""
    ) -> Estimate:
        """Return this outcome's success less another's, paired by episode, from -1 to 1.

        `family` is a scenario's name, or that of the mean over families (scenarios); `level` is the
        confidence of the interval. `metric` names plain or balanced success; empty takes the one
        that is shown first.
        """
        return mean_difference([*self._pairs(other, family, metric)], level)

    def p_over(self, other: "Outcome") -> float | None:
        """Return the p-value of success being the same in this outcome and in another.

        It is of the mean over families (scenarios); None if no interval is known.
        """
        return p_of_mean([*self._pairs(other, MEAN)])

    def _pairs(
        self, other: "Outcome", family: str, metric: str = ""
    ) -> Iterator[tuple[Success, Floats, Floats]]:
        """Yield the success rule of each family, and success (S, E) of this and of the other."""
        for name in self._of(family):
            rule = self.success_rules[name]
            if metric == SUCCESS:
                rule = rule.plain
            yield rule, self.families[name][SUCCESS], other.families[name][SUCCESS]

    def pooled(self, groups: Mapping[str, Bools]) -> Floats:
        """Return success, 1 or 0, of the n episodes in a group, of all scenarios together, (S, n).

        `groups` has, by scenario's name, a mask (E,): which of its E episodes are in the group,
        such as those in which one helper sees the danger. S is the number of channel seeds.
        """
        parts = []
        for family, values in self.families.items():
            parts.append(values[SUCCESS][:, groups[family]])
        return np.hstack(parts)

    def pooled_clusters(self, groups: Mapping[str, Bools]) -> Ints | None:
        """Return the number of each cluster of the n episodes of `pooled`, (n,), from 0.

        None if each is its own; the episodes of scenarios that name a cluster alike are in one.
        """
        clusters = clusters_of([self.success_rules[family] for family in self.families])
        if clusters is None:
            return None
        parts = []
        for family, numbers in zip(self.families, clusters, strict=True):
            parts.append(numbers[groups[family]])
        return np.unique(np.concatenate(parts), return_inverse=True)[1]

    def _of(self, family: str) -> list[str]:
        return list(self.families) if family == MEAN else [family]


@dataclass(frozen=True)
class Result:
    """Hold the outcomes of one model with every content of messages at every grid point.

    A grid point is an operating point (settings of radio, asking and fusion) with one value
    changed, as `panels` list them. The key of an outcome is the operating point, of which the
    content is a setting, and the number of vehicles.
    """

    model: Model  # the model and its runs
    panels: Sequence[Panel]  # the axes and conditions that were played
    # by operating point, of which the content is a setting, and number of vehicles
    outcomes: Mapping[Place, Outcome]

    def at(self, setting: Setting, content: str) -> Outcome:
        """Return how well the ego does with a content of messages, such as `objects`.

        `setting` is the grid point: an operating point (settings of radio, asking and fusion), and
        a number of vehicles.
        """
        return self.outcomes[place(setting, content)]

    @property
    def base(self) -> Setting:
        """Return the grid point in which nothing is changed: the study's first condition as it is.

        A condition is a named set of settings of radio, asking and fusion, and a grid point such
        settings with one value changed, and a number of vehicles.
        """
        return self.panels[0].settings[0]

    @property
    def points(self) -> list[Setting]:
        """Return every grid point of the study once, in order, though panels may share it.

        A grid point is settings of radio, asking and fusion, with one value changed, and a number
        of vehicles. A panel has those in which the same setting is varied.
        """
        return distinct(self.panels)

    @property
    def others(self) -> list[str]:
        """Return the contents that are compared with `intent`: all others that were played.

        A content is what messages hold: `intent` is a vehicle's probabilities of actions, `objects`
        a list of what it sees; `nothing` is an ego that asks nobody.
        """
        return [content for content in self.model.contents if content != INTENT]

    @property
    def sent(self) -> list[str]:
        """Return what messages can hold beside intents in this study, such as `text` or `objects`.

        An intent is probabilities of actions. `nothing`, an ego that asks nobody, and `oracle`, the
        whole truth, are left out, as no message holds them.
        """
        return [
            content
            for content in self.others
            if content != NOTHING and TRUTH not in CONTENTS[content].holds
        ]

    @cached_property
    def _p(self) -> dict[Place, float | None]:
        places, p_values = list[Place](), list[float | None]()
        for setting in self.points:
            intent = self.at(setting, INTENT)
            for content in self.others:
                places.append(place(setting, content))
                p_values.append(self.at(setting, content).p_over(intent))
        return dict(zip(places, corrected(p_values), strict=True))

    def p(self, setting: Setting, content: str) -> float | None:
        """Return the p-value of no change in success by another content of messages than intents.

        It compares success when messages hold `content`, such as `objects`, with that when they
        hold intents (a vehicle's probabilities of actions), over the same episodes. `setting` is
        the grid point: settings of radio, asking and fusion, and a number of vehicles. The p-value
        is corrected by Holm's method over all contents and grid points of the model; it is None for
        intents themselves, and where no interval is known.
        """
        return self._p.get(place(setting, content))

    @property
    def headline_metric(self) -> str:
        """Return the name of the metric of success that is shown first, plain or balanced.

        Balanced success is the mean over episodes with a danger (a vehicle that the ego would meet)
        and without.
        """
        return self.at(self.base, INTENT).headline_metric

    @property
    def words(self) -> str:
        """Return the first metric's name for people, such as `balanced success`."""
        return IN_WORDS[self.headline_metric]

    @property
    def successes(self) -> tuple[str, ...]:
        """Return the names of the metrics of success to show: the first, then its halves if any.

        Balanced success is the mean of two halves: over episodes with a danger (a vehicle that the
        ego would meet) and without.
        """
        return self.headline_metric, *entry(self.headline_metric).halves

    @property
    def families(self) -> list[str]:
        """Return the names of the families (scenarios), and `mean` where there are several."""
        names = list(self.model.runs)
        return [*names, MEAN] if len(names) > 1 else names


def holding(point: OperatingPoint, content: str) -> OperatingPoint:
    """Return an operating point at which messages hold this content, such as `objects`.

    An operating point is the settings of radio, asking and fusion. With `nothing`, it is one at
    which the ego never asks.
    """
    if content == NOTHING:
        return point.changed(content=INTENT, schedule=NEVER, threshold=None)
    return point.changed(content=content)


def place(setting: Setting, content: str) -> Place:
    """Return the key in `Result.outcomes` of the outcome with a content of messages.

    It is the operating point (settings of radio, asking and fusion) in which messages hold that
    content, such as `objects`, and the number of vehicles. `setting` is the grid point.
    """
    return holding(setting.point, content), setting.vehicles


def distinct(panels: Sequence[Panel]) -> list[Setting]:
    """Return the grid points of all panels in order, each once, though panels may share it.

    A grid point is settings of radio, asking and fusion, with one value changed, and a number of
    vehicles. A panel has those in which the same setting is varied.
    """
    every = [setting for panel in panels for setting in panel.settings]
    last_first = {place(setting, INTENT): setting for setting in reversed(every)}
    return list(last_first.values())[::-1]


def folders(path: Path) -> list[Path]:
    """Return the folders of the runs in a suite's folder, or the folder itself if it is a run's.

    A suite is a run of one model on each of several datasets.
    """
    if (path / SUITE).is_file():
        return [path / name for name in contents_of(path).families.values()]
    return [path]


def models(given: Sequence[Sequence[ReplayedRun]], panels: Sequence[Panel]) -> list[Model]:
    """Group runs by model, each with what messages may hold when its runs are played again.

    Args:
        given: the runs of a suite together, which are of one model, or a run alone.
        panels: the conditions, and the settings varied in them, that are to be played.

    Raises:
        UserError: two runs of a model are on the same family (scenario) or differ in what is asked
            and timed, or a model cannot play messages that hold intents.
    """
    by_model: dict[str, dict[str, ReplayedRun]] = {}
    for runs in given:
        variants = [run.run.manifest.variant for run in runs]
        prompts = " and ".join(dict.fromkeys(variant.prompt for variant in variants))
        name = str(structs.replace(variants[0], prompt=prompts))
        by_family = by_model.setdefault(name, {})
        for run in runs:
            family = run.dataset.scenario.name
            if family in by_family:
                other = by_family[family].run.path
                raise UserError(
                    f"{printable(run.run.path)} and {printable(other)} are both "
                    f"{printable(name)} on {printable(family)}; give one of them"
                )
            first = next(iter(by_family.values()), run)
            if unlike := different(_setup(first), _setup(run)):
                raise UserError(
                    f"{printable(run.run.path)} and {printable(first.run.path)} are both "
                    f"{printable(name)}, and differ in {unlike}; give runs of one evaluation"
                )
            by_family[family] = run
    points = [setting.point for setting in distinct(panels)]
    models = []
    for name, by_family in by_model.items():
        left_out = dict(_unable(list(by_family.values()), points))
        if INTENT in left_out:
            raise UserError(f"{printable(name)}: {left_out[INTENT]}")
        models.append(Model(name, by_family, left_out))
    return models


def _setup(run: ReplayedRun) -> dict[str, Any]:
    """Return what runs of one model must have alike; each family may have a prompt of its own."""
    return {**setup(run.run), "prompt": ""}


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
    """Return what a study varies: a panel for each condition as it is, and for each of its axes.

    A condition is a text that names settings of radio, asking and fusion, such as
    `6g:encoding=etsi`. An axis is one setting that is varied, such as `loss`, and a panel has all
    its values in one condition. `over` names the axes, and `grids` has the text of each one's
    values, such as `0,0.1,0.2`, in the same order; without conditions and axes, the usual ones
    (`USUAL`) are taken. Raises UserError for a condition, axis or value that does not exist or that
    the runs cannot play, or if there are more grids than axes.
    """
    if len(grids) > len(over):
        raise UserError(
            f"--grid: {len(grids)} given for {len(over)} of --over; give one for each, in order"
        )
    if conditions or over:
        conditions = distinct_names(runs, conditions or [BASE])
        axes = list(zip_longest(over, grids))  # None where an axis has no grid
        varied = [(condition, *axis) for condition in conditions for axis in axes]
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
    """Return how many questions a study will have to ask a model, at most, by run and role.

    Use it to tell the cost before the study is played. The study plays finished runs again with
    other settings and other contents of messages; what was not answered before must be asked.

    Args:
        model: the model's runs, with their stored answers.
        panels: the settings of radio, asking and fusion that the study will play, grouped by the
            setting that is varied.

    Returns:
        By family (the scenario's name of each run) the number of questions by role: `ego`,
        `helper`, and `fusion` for an ego that is asked again with messages. They count the
        situations that the run or a rule driver came to; an ego that decides otherwise may come to
        others.
    """
    points = set[OperatingPoint]()
    for setting in distinct(panels):
        points |= {holding(setting.point, content) for content in model.contents}
    counts = {}
    for family, run in model.runs.items():
        spec = replace(run.spec, points=tuple(points))
        scenes = sorted({*run.dataset.courses(), *run.run.decisions.scenes})
        counts[family] = lacking(spec, run.dataset, scenes, run.answers)
    return counts


def manifest_of(
    swarms: Sequence[Model], panels: Sequence[Panel], seeds: Sequence[int]
) -> dict[str, Any]:
    """Return what tells one study from another, as plain values by name, for its `contents.json`.

    They are the models' runs (`sources`), the contents of messages, the channel's `seeds`, and the
    operating points (settings of radio, asking and fusion) that are played.
    """
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
    """Play every content of messages at every grid point with every model's runs.

    A content is what messages hold, such as `objects`; a grid point is an operating point (settings
    of radio, asking and fusion) with one value changed.

    Args:
        swarms: the models with their runs.
        panels: the conditions, and the settings varied in them.
        seeds: the keys of the channel's random draws, the same for every content.
        out: the folder of the study, which may hold the same one only.
        progress: told how many points there are to play, and called with 1 after each.

    Returns one result a model, in their order, with the success and cost of each content.

    Raises:
        UserError: the folder `out` holds another study.
        Unanswered: too many questions got no answer; the runs keep all others.
    """
    refuse_other(out, "contents", manifest_of(swarms, panels, seeds))
    points = distinct(panels)
    progress.more(sum(len(model.contents) * len(model.runs) * len(points) for model in swarms))
    results = [_played(model, panels, points, seeds, progress) for model in swarms]
    for model in swarms:
        for run in model.runs.values():
            run.settle()
    return results


def _played(
    model: Model,
    panels: Sequence[Panel],
    points: Sequence[Setting],
    seeds: Sequence[int],
    progress: Progress,
) -> Result:
    """Return what a model's runs come to with every content at every point."""
    settings = [
        replace(setting, point=holding(setting.point, content))
        for content in model.contents
        for setting in points
    ]
    metrics: dict[Place, dict[str, Mapping[str, Floats]]] = {}  # by place and family
    for family, run in model.runs.items():
        columns = partial(_columns, run.dataset.scenario.parameters)
        walks = run.walked(settings, seeds, columns)
        for setting, [walk] in zip(settings, walks, strict=True):
            of_family = {**walk.ends, **by_episode(walk, METRICS)}
            metrics.setdefault((setting.point, setting.vehicles), {})[family] = of_family
            progress(1)
    by_run = counted(list(model.runs.values()))
    rules = {family: by_run[run] for family, run in model.runs.items()}
    outcomes = {key: Outcome(by_family, rules) for key, by_family in metrics.items()}
    return Result(model, panels, outcomes)


def _columns(parameters: Parameters, part: Decided[Any]) -> dict[str, Floats]:
    """Return the columns that the metrics are of, and `off_lag`: whether a decision would begin
    in another frame than that of its world, each (n,).
    """
    seconds, place = np.unique(part.result.latency_s, return_inverse=True)
    is_off = []
    for each in seconds.tolist():
        if np.isnan(each):
            is_off.append(np.nan)
        else:
            is_off.append(frames(each, parameters.simulation_hz) != parameters.lag_frames)
    return {**metric_columns(part), "off_lag": np.array(is_off)[place]}


def witnesses(run: ReplayedRun) -> Ints:
    """Return how many helpers see the danger at the first decision of each of E episodes, (E,).

    The danger is the vehicle that the ego would meet if it drove on. In place of a number there is
    `SAFE` (-1) without a danger, and `HEARD` (-2) if the danger has a radio, whose beacons tell of
    it.
    """
    forest, scenario = run.dataset.forest, run.dataset.scenario
    roots = [forest.ids[n] for n in forest.root.tolist()]
    counts = []
    for scene in run.dataset.scenes(roots):
        danger = scene.record.danger
        if danger.vehicle is None:
            counts.append(SAFE)
        elif radios(scenario, scene.state.episode_seed, danger.sector)["danger_radio"]:
            counts.append(HEARD)
        else:
            count = 0
            for helper in scene.viewers[1:]:
                nodes = scene.graphs[helper].nodes
                count += any(node.id == danger.vehicle for node in nodes)
            counts.append(count)
    return np.array(counts)


def groups(model: Model) -> dict[str, dict[str, Bools]]:
    """Return groups of episodes by how many helpers see the danger, by the group's name in words.

    A group has by family (scenario) a mask, (E,): which of its E episodes are in it. The danger is
    the vehicle that the ego would meet if it drove on.
    """
    counts = {family: witnesses(run) for family, run in model.runs.items()}
    most = max(int(of_family.max()) for of_family in counts.values())
    numbers = {"no danger": SAFE}
    for n in range(most + 1):
        numbers[f"a danger, seen by {n}"] = n
    numbers["a danger with a radio"] = HEARD
    named = {}
    for name, number in numbers.items():
        named[name] = {family: of_family == number for family, of_family in counts.items()}
    named["any danger"] = {family: of_family != SAFE for family, of_family in counts.items()}
    groups = {}
    for name, episodes in named.items():
        if any(of_family.any() for of_family in episodes.values()):
            groups[name] = episodes
    return groups
