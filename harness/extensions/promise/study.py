"""`harness study promise`: thresholds with which a model does little harm, and what they cost.

They are chosen on tune layouts, from a grid that is fixed before, by tests that are right together
(`risk`), and verified on report layouts. Other runs show what happens where nothing is promised.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import DASH, PERCENT, amount, interval_of
from harness.core.progress import Progress
from harness.core.seeds import purposes, seeds_text
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.dataset import rebuilt
from harness.evaluate.table import columns
from harness.evaluate.walk import Decided
from harness.extensions.promise.grid import Grid, grid_of
from harness.extensions.promise.promises import WHAT, Harm, Promise, settings_of
from harness.extensions.promise.risk import best, p_values, units_needed
from harness.report.document import Table
from harness.runs.alike import different, setup
from harness.runs.estimates import over_episodes
from harness.runs.fit import check_answerers, check_seeds, question_of, weights_of
from harness.runs.headline import SUCCESS
from harness.runs.run_dataset import check_scenes
from harness.runs.success import Success
from harness.studies.axes import Setting, described
from harness.studies.play import WalkResult
from harness.studies.replayed_run import ReplayedRun, counted
from harness.studies.study import Study, ends, refuse_other
from harness.studies.sweep import point_of

if TYPE_CHECKING:
    import pandas as pd

DELTA = 0.05
AT_MOST = (0.01, 0.02, 0.05, 0.1)
WORDS: dict[Harm, str] = {"unsafe": "unsafe episodes", "failed": "failed episodes"}
AS_IT_IS, ALWAYS = "as it is", "always careful"
COSTS = ("requests", "latency_ms", "careful", "asked")
HEADS = (
    "setting",
    "tau",
    "careful",
    "harm %",
    "on tune %",
    "success %",
    "requests",
    "ms",
    "careful %",
    "asked %",
)


@dataclass(frozen=True)
class Outcome:
    """Hold how an ego does under one setting, for S seeds of the channel and E layouts."""

    harm: Floats  # 1 where an episode did harm, else 0, (S, E)
    success: Floats  # 1 where it succeeded, else 0, (S, E)
    costs: Mapping[str, float]  # means by name of `COSTS`: per episode, or of decisions

    def units(self, clusters: Ints | None) -> Floats:
        """Return the mean harm of each of n units that are drawn independently, (n,).

        A unit is a layout or, where layouts are cut from fewer scenes, such a cluster; `clusters`,
        (E,), has the number of each one's.
        """
        means: Floats = self.harm.mean(axis=0)
        if clusters is not None:
            means = np.bincount(clusters, means) / np.bincount(clusters)
        return means


@dataclass(frozen=True)
class Played:
    """Hold the outcomes of some settings on the layouts of one run."""

    run: ReplayedRun
    outcomes: Mapping[OperatingPoint, Outcome]  # by setting, as a condition
    success_rule: Success  # how success is averaged over episodes

    def harm(self, point: OperatingPoint) -> Estimate:
        """Return the mean harm under a setting, 0 to 1, with its 95 % interval over layouts."""
        return over_episodes(SUCCESS, self.outcomes[point].harm, self.run.clusters)

    def success(self, point: OperatingPoint) -> Estimate:
        """Return success under a setting, 0 to 1, with its 95 % interval over layouts."""
        return self.success_rule.estimate(self.outcomes[point].success)


@dataclass(frozen=True)
class Level:
    """Hold what can be promised of one share of harm."""

    at_most: float  # the share of harm
    needed: int  # number of tune layouts, all without harm, that a promise needs
    certified: int  # number of settings that may promise it
    chosen: OperatingPoint | None  # the best of them; None if there is none

    @property
    def label(self) -> str:
        """Return what tables call it, such as `≤ 5 %`."""
        return f"≤ {_percent(self.at_most)} %"


@dataclass(frozen=True)
class Result:
    """Hold a study of what one model may promise: levels, and outcomes on all layouts."""

    harm: Harm  # what counts as harm
    delta: float  # probability that a promise is wrong, at most
    grid: Grid  # the settings that were tried
    conditions: Sequence[OperatingPoint]  # those whose thresholds were varied
    seeds: Sequence[int]  # of the channel
    tune: Played  # all settings, on tune layouts
    report: Played  # some, on report layouts
    elsewhere: Sequence[Played]  # the same, on layouts that no promise is of
    levels: Sequence[Level]

    @cached_property
    def units(self) -> Floats:
        """Return the mean harm on tune layouts by setting and unit, (L, n), in the grid's order."""
        clusters = self.tune.run.clusters
        outcomes = [self.tune.outcomes[point] for point in self.grid.points]
        return np.array([outcome.units(clusters) for outcome in outcomes])

    @property
    def rows(self) -> dict[str, OperatingPoint]:
        """Return the settings that are shown, by label: references, and that of each level."""
        several = len(self.conditions) > 1
        rows = {}
        for condition in self.conditions:
            name = f" {condition.name}" if several else ""
            rows[f"{AS_IT_IS}{name}"] = condition
        actions = len(self.tune.run.run.actions)
        rows[ALWAYS] = grid_of(self.conditions[:1], actions, "unsafe").points[0]
        for level in self.levels:
            if level.chosen:
                rows[level.label] = level.chosen
        return rows


def run_promise(
    runs: Sequence[ReplayedRun],
    tune: ReplayedRun,
    conditions: Sequence[str],
    harm: Harm,
    levels: Sequence[float],
    delta: float,
    seeds: Sequence[int],
    out: Path,
    progress: Progress,
) -> Result:
    """Choose thresholds on tune layouts, and play them on others.

    Args:
        runs: the run on report layouts; then those on layouts of which nothing is promised.
        tune: the run on tune layouts, of the same model, prompt and scenario as the first.
        conditions: texts of the conditions whose thresholds are varied; empty for those of `tune`
            that have a channel.
        harm: what counts as harm.
        levels: the shares of harm that are promised, each between 0 and 1; empty for the usual.
        delta: the probability that a promise is wrong, at most.
        seeds: of the channel, over which harm is averaged.
        out: the folder of the study.
        progress: told how many settings there are to play, and called with 1 after each.

    Raises:
        UserError: the runs are on other layouts, or do not go together, or there are too few tune
            layouts for every level, or for a level that is given.
        Unanswered: too many questions got no answer; the runs keep all others.
    """
    report, *elsewhere = runs
    points = [point_of([tune], name) for name in conditions or usual(tune)]
    if not points:
        raise UserError(
            f"{printable(tune.run.path)}: no condition has a channel; give --condition 6g"
        )
    check(runs, tune)
    n = len(np.unique(tune.clusters)) if tune.clusters is not None else tune.episodes
    needed = {level: units_needed(level, delta) for level in levels or AT_MOST}
    beyond = [level for level in needed if needed[level] > n]
    if beyond and (levels or len(beyond) == len(needed)):
        raise UserError(
            f"--tune {printable(tune.run.path)}: {amount(n, 'independent layout')}, and a promise "
            f"of {_percent(beyond[-1])} % needs {needed[beyond[-1]]} without harm (delta = "
            f"{_percent(delta)} %); give a run on more, or a larger --at-most"
        )
    grid = grid_of(points, len(tune.run.actions), harm)
    manifest = manifest_of([*runs, tune], grid, harm, list(needed), delta, seeds)
    refuse_other(out, "promise", manifest)
    progress.more(len(grid.points) + len(runs) * (1 + len(points) + len(needed)))
    rules = counted([tune, report])
    on_tune = Played(tune, play(tune, grid.points, harm, seeds, progress), rules[tune])
    result = Result(harm, delta, grid, points, seeds, on_tune, on_tune, (), ())
    result = replace(result, levels=[choose(result, level, needed[level]) for level in needed])
    rows = tuple(dict.fromkeys(result.rows.values()))
    played = Played(report, play(report, rows, harm, seeds, progress), rules[report])
    others = [
        Played(run, play(run, rows, harm, seeds, progress), counted([run])[run])
        for run in elsewhere
    ]
    for run in (*runs, tune):
        run.settle()
    return replace(result, report=played, elsewhere=others)


def usual(tune: ReplayedRun) -> list[str]:
    """Return the names of a run's conditions whose thresholds can be varied.

    They have a channel, and keep no promise already.
    """
    names = []
    for name, point in tune.points.items():
        if point.radio.profile is not None and not point.setting("promise"):
            names.append(name)
    return names


def manifest_of(
    runs: Sequence[ReplayedRun],
    grid: Grid,
    harm: Harm,
    levels: Sequence[float],
    delta: float,
    seeds: Sequence[int],
) -> dict[str, Any]:
    """Return what tells one study from another, as plain values by name, for its `promise.json`.

    `runs` are those that it plays, that on tune layouts last.
    """
    vehicles = runs[-1].vehicles
    return {
        "sources": [run.manifest() for run in runs],
        "harm": harm,
        "at_most": list(levels),
        "delta": delta,
        "seeds": list(seeds),
        "panels": described({"tune": [Setting(p.name, p, vehicles) for p in grid.points]}),
    }


def check(runs: Sequence[ReplayedRun], tune: ReplayedRun) -> None:
    """Raise UserError unless runs go together, the first on report layouts and `tune` on tune ones.

    The first must differ from `tune` in its layouts alone; others may be of other scenarios. What
    is chosen by is rebuilt in the simulator, in part.
    """
    report, *elsewhere = runs
    name = printable(tune.run.path)
    check_answerers(tune.run)
    check_seeds(f"--tune {name}", WHAT, *_range(tune))
    low, high = _range(report)
    if purposes(low, high - low + 1) != ["report"]:
        raise UserError(
            f"{printable(report.run.path)}: {seeds_text(low, high - low + 1)}; give a run on "
            "report layouts, which no threshold is chosen on"
        )
    whole = setup(tune.run, tune.dataset.scenario)
    for run in runs:
        other = setup(run.run, run.dataset.scenario)
        if run is not report:
            other = {**other, "scenario": whole["scenario"], "prompt": whole["prompt"]}
        if unlike := different(whole, other):
            raise UserError(
                f"--tune {name} differs from {printable(run.run.path)} in {unlike}; give a run "
                "that differs in its layouts alone"
            )
    rebuilt.refuse(tune.dataset, [run.dataset for run in (report, *elsewhere)])
    check_scenes(tune.run, tune.dataset)


def _range(run: ReplayedRun) -> tuple[int, int]:
    seeds = run.dataset.forest.seeds
    return int(seeds.min()), int(seeds.max())


def play(
    run: ReplayedRun,
    points: Sequence[OperatingPoint],
    harm: Harm,
    seeds: Sequence[int],
    progress: Progress,
) -> dict[OperatingPoint, Outcome]:
    """Play settings on a run's layouts from its stored answers; return outcomes by setting.

    Raises UserError if the model may not be asked and a setting comes to a decision point without
    an answer: a promise is of all layouts.
    """
    settings = [Setting(point.name, point, run.vehicles) for point in points]
    outcomes = {}
    for point, [walk] in zip(points, run.walked(settings, seeds, _columns), strict=True):
        if run.left_out:
            raise UserError(
                f"{printable(run.run.path)}: no stored answer at {len(run.left_out)} decision "
                "points that a setting leads to, and a promise is of all layouts; leave out "
                "--no-model"
            )
        outcomes[point] = _outcome(walk, harm)
        progress(1)
    return outcomes


def _columns(part: Decided[Any]) -> dict[str, Floats]:
    every = columns(part)
    return {
        "requests": every["requests"],
        "latency_ms": every["latency_ms"],
        "asked": every["triggered"],
        "careful": (part.result.action == 0).astype(float),
    }


def _outcome(walk: WalkResult, harm: Harm) -> Outcome:
    success = walk.ends[SUCCESS]
    harms = walk.ends["unsafe_rate"] if harm == "unsafe" else 1 - success
    means = {
        name: float(np.mean(walk.columns[name])) for name in ("latency_ms", "careful", "asked")
    }
    requests = float(walk.columns["requests"].sum()) / success.size
    return Outcome(harms, success, {"requests": requests, **means})


def choose(result: Result, at_most: float, needed: int) -> Level:
    """Return what can be promised of a share of harm, by the outcomes on tune layouts.

    Of all certified settings that with the most success there is chosen, of these that with the
    fewest requests. `needed` is how many layouts without harm a promise needs.
    """
    means, n = result.units.mean(axis=1), result.units.shape[1]
    p = p_values(means, n, at_most, is_binary(result))
    certified = result.grid.order.certified(p, result.delta) & (n >= needed)
    outcomes = [result.tune.outcomes[point] for point in result.grid.points]
    success = np.array([result.tune.success_rule.mean(each.success) for each in outcomes])
    requests = np.array([outcome.costs["requests"] for outcome in outcomes])
    place = int(best(certified, success, requests))
    chosen = None if place < 0 else result.grid.points[place]
    return Level(at_most, needed, int(certified.sum()), chosen)


def is_binary(result: Result) -> bool:
    """Return whether the harm of a unit can be nothing but 0 or 1: of one layout and one draw."""
    return len(result.seeds) == 1 and result.tune.run.clusters is None


def promise_of(result: Result, level: Level, command: str) -> Promise:
    """Return the promise of a level, to be written as a file; `command` is the one as typed.

    Raises UserError if no setting can promise it.
    """
    run, point = result.tune.run, level.chosen
    if point is None:
        raise UserError(f"{unable(result, level)}; no file is written")
    first, last = _range(run)
    manifest, scenario = run.run.manifest, run.dataset.scenario
    at = result.grid.points.index(point)
    return Promise(
        command=command,
        fitted_on=f"{run.name} on {run.dataset.name}, {seeds_text(first, last - first + 1)}, "
        f"{amount(run.episodes, 'layout')}",
        first_seed=first,
        last_seed=last,
        scenario=scenario.name,
        actions=tuple(run.run.actions),
        question=question_of({**manifest.agent(0), "model": manifest.answerers.model}),
        weights=weights_of(manifest.answerers.identity),
        harm=result.harm,
        at_most=level.at_most,
        delta=result.delta,
        settings=settings_of(point),
        **{key: point.setting(key) for key in ("tau_nats", "careful_nats")},
        units=result.units.shape[1],
        mean_harm=float(result.units[at].mean()),
        channel_seeds=tuple(result.seeds),
        dataset_sha256=run.dataset.sha256,
    )


def promise_study(result: Result, out_runs: Sequence[ReplayedRun]) -> Study:
    """Return the study (sentences, tables) of what a model may promise; `out_runs` are all runs."""
    data = tables(result)
    n, seeds = result.units.shape[1], ", ".join(map(str, result.seeds))
    first, last = _range(result.tune.run)
    return Study(
        "promise",
        f"What {result.report.run.name} may promise",
        [
            needs(result),
            *(sentence(result, level) for level in result.levels),
            *filter(None, (outside(result, level) for level in result.levels)),
        ],
        [
            f"Harm is the share of {WORDS[result.harm]}, averaged over channel seeds {seeds}. "
            f"Thresholds are chosen on n = {n} layouts ({seeds_text(first, last - first + 1)}). "
            f"{len(result.grid.points)} settings were fixed before, and are tested in "
            f"{len(result.grid.order.chains)} chains by "
            f"{'exact binomial tails' if is_binary(result) else 'the Hoeffding-Bentkus bound'}, "
            f"which are right together with probability {1 - result.delta:g} (learn then test, "
            "arXiv:2110.01052). 95 % intervals are over layouts.",
            "A promise is of layouts that are drawn as the tune layouts are, with this model, "
            "prompt, scenario and condition. Of other roads, radios and models it says nothing.",
        ],
        [_table(result, result.report), *(_table(result, each) for each in result.elsewhere)],
        data,
        {
            **manifest_of(
                out_runs,
                result.grid,
                result.harm,
                [level.at_most for level in result.levels],
                result.delta,
                result.seeds,
            ),
            "versions": versions(),
        },
        data["promise"],
        caveats=[caveat for run in out_runs for caveat in run.caveats],
    )


def needs(result: Result) -> str:
    """Return a sentence on how many tune layouts promises need, and how many there are."""
    shares = ", ".join(_percent(level.at_most) for level in result.levels)
    counts = ", ".join(str(level.needed) for level in result.levels)
    return (
        f"To promise {shares} % (delta = {_percent(result.delta)} %) takes {counts} tune layouts "
        f"without harm; here are {result.units.shape[1]}."
    )


def sentence(result: Result, level: Level) -> str:
    """Return what a level promises and costs, on report layouts, or that it cannot be promised."""
    if level.chosen is None:
        return f"{unable(result, level)}."
    report, point = result.report, level.chosen
    base = next(each for each in result.conditions if each.name == point.name)
    before, after = report.outcomes[base], report.outcomes[point]
    change = report.success_rule.difference(after.success, before.success)
    requests = after.costs["requests"] - before.costs["requests"]
    late_ms = after.costs["latency_ms"] - before.costs["latency_ms"]
    careful = " (the ego always takes its first action)" if is_always(point) else ""
    return (
        f"{WORDS[result.harm].capitalize()} ≤ {_percent(level.at_most)} % costs {requests:+.1f} "
        f"requests an episode, {late_ms:+.1f} ms a decision and {interval_of(change, sign='+')} "
        f"points of {report.success_rule.words}{careful}: {interval_of(report.harm(point))} % on "
        f"report layouts, by {typed(point)}."
    )


def is_always(point: OperatingPoint) -> bool:
    """Return whether an ego is always careful under a condition."""
    return bool(point.setting("careful_nats") == 0)


def outside(result: Result, level: Level) -> str:
    """Return a sentence on the harm of a level's setting where nothing is promised.

    It is on the layouts with the most harm of those that are not drawn as the tune layouts are;
    empty without such.
    """
    if not result.elsewhere or level.chosen is None:
        return ""
    harms = {each.run.dataset.name: each.harm(level.chosen) for each in result.elsewhere}
    worst = max(harms, key=lambda name: harms[name].value)
    verdict = "is not kept" if harms[worst].low > level.at_most else "may be kept"
    return (
        f"On other roads {level.label} is no promise: on {worst} it {verdict}, with "
        f"{interval_of(harms[worst])} % harm."
    )


def unable(result: Result, level: Level) -> str:
    """Return in words that no setting can promise a level."""
    claim = f"{WORDS[result.harm]} ≤ {_percent(level.at_most)} %"
    if level.needed > result.units.shape[1]:
        return f"{claim}: too few tune layouts to promise it"
    return f"No setting of {result.report.run.name} can promise {claim}"


def typed(point: OperatingPoint) -> str:
    """Return the text of a condition with its thresholds, as it is typed."""
    careful_nats = point.setting("careful_nats")
    careful = "" if careful_nats is None else f",careful_nats={careful_nats:g}"
    separator = "," if ":" in point.name else ":"
    return f"{point.name}{separator}tau={point.setting('tau_nats'):g}{careful}"


def _table(result: Result, played: Played) -> Table:
    inside = played is result.report
    rows = []
    for label, point in result.rows.items():
        costs = played.outcomes[point].costs
        careful_nats = point.setting("careful_nats")
        on_tune = result.tune.outcomes.get(point)
        rows.append(
            [
                label,
                f"{point.setting('tau_nats'):.3g}",
                DASH if careful_nats is None else f"{careful_nats:.3g}",
                interval_of(played.harm(point)),
                PERCENT.text(on_tune.harm.mean()) if on_tune else DASH,
                interval_of(played.success(point)),
                f"{costs['requests']:.1f}",
                f"{costs['latency_ms']:.1f}",
                PERCENT.text(costs["careful"]),
                PERCENT.text(costs["asked"]),
            ]
        )
    return Table(
        f"{played.run.name} on {played.run.dataset.name}"
        f"{'' if inside else ': outside of every promise'}",
        HEADS,
        rows,
        "Nats: tau, above which the ego asks, and careful, from which it takes the first action. "
        f"Harm is the share of {WORDS[result.harm]}. Requests are an episode's, ms a decision's; "
        "careful %: decisions with the first action, asked %: that ask.",
        terminal=[0, 1, 2, 3, 5, 6, 7],
    )


def tables(result: Result) -> "dict[str, pd.DataFrame]":
    """Return the data frames `promise` and `settings`, by these names, to write as files.

    `promise` has a row for each shown setting and each run; `settings` one for each setting that
    was tried on tune layouts, with its p-value for each level.
    """
    import pandas as pd

    rows, settings = list[dict[str, Any]](), list[dict[str, Any]]()
    labels = {level.label for level in result.levels}
    for played in (result.report, *result.elsewhere):
        for label, point in result.rows.items():
            row = {
                "run": played.run.name,
                "dataset": played.run.dataset.name,
                "promised": played is result.report and label in labels,
                "setting": label,
                **_thresholds(point),
            }
            for name, estimate in (
                ("harm", played.harm(point)),
                ("success", played.success(point)),
            ):
                row |= {f"{name}_{key}": value for key, value in ends(estimate).items()}
            base = next(each for each in result.conditions if each.name == point.name)
            outcomes, rule = played.outcomes, played.success_rule
            over = rule.difference(outcomes[point].success, outcomes[base].success)
            row |= {f"success_over_{key}": value for key, value in ends(over).items()}
            rows.append({**row, **outcomes[point].costs})
    means, n = result.units.mean(axis=1), result.units.shape[1]
    for place, point in enumerate(result.grid.points):
        outcome = result.tune.outcomes[point]
        row = {**_thresholds(point), "harm": means[place], "n": n, **outcome.costs}
        row["success"] = result.tune.success_rule.mean(outcome.success)
        for level in result.levels:
            p = p_values(means[place], n, level.at_most, is_binary(result))
            row[f"p_{_percent(level.at_most)}"] = float(p)
        settings.append(row)
    return {"promise": pd.DataFrame(rows), "settings": pd.DataFrame(settings)}


def _thresholds(point: OperatingPoint) -> dict[str, Any]:
    names = ("tau_nats", "careful_nats")
    return {"condition": point.name, **{name: point.setting(name) for name in names}}


def _percent(share: float) -> str:
    return f"{100 * share:.6g}"
