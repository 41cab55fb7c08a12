"""`harness study contents`: what a message should hold, at equal bits and by the age of what is known.

Every content is played at every point from stored answers, with the same draws; `nothing` is an ego that asks
nobody. A model's runs on several families of scenes are averaged with equal weight, and differences to
intents are paired by episode within each family.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from msgspec import structs

from harness.coordination.contents import CONTENTS, INTENT, TRUTH
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.scheduling import NEVER
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import shown
from harness.core.formats import SUITE
from harness.core.multiplicity import LEVEL, p_value
from harness.core.progress import Progress
from harness.core.statistics import Estimate, mean_of
from harness.core.versions import versions
from harness.evaluate.dry_run import lacking
from harness.evaluate.walk import Decided
from harness.report.document import Table, strong
from harness.report.drawing.colours import COLOURS, MARKERS
from harness.report.suite import MEAN
from harness.runs.metrics import LATENCY, SUCCESS, difference, over_episodes
from harness.runs.suite import contents_of
from harness.studies.axes import Setting, axis_of, described, grid
from harness.studies.figures.lines import along
from harness.studies.figures.points import Steps, fronts
from harness.studies.ledger import paper_numbers
from harness.studies.play import by_episode, metric_columns
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, corrected, p_cell, percent, refuse_other
from harness.studies.sweep import point_of, settings
from harness.world.lookouts import radios
from harness.world.parameters import frames

if TYPE_CHECKING:
    import pandas as pd

NOTHING = "nothing"
PLAYED = (NOTHING, *CONTENTS)
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
BESIDE = 3  # panels of a figure
SAFE, HEARD = -1, -2  # in place of a number of witnesses
SPENDING = ("tau_nats", "max_helpers")  # axes that vary the bits
# The paper's panels by axis, and what is added to their values: its N counts the ego.
PAPER = {"loss": ("loss", 0.0), "tau_nats": ("tau", 0.0), "max_helpers": ("size", -1.0)}


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
    """What a model's runs came to at one point: metrics by family, each (S, E)."""

    families: Mapping[str, Mapping[str, Floats]]

    def estimate(self, metric: str, family: str = MEAN) -> Estimate:
        """Return a metric of a family, or its mean over families."""
        return mean_of([over_episodes(metric, each[metric]) for each in self._of(family)])

    def over(self, other: "Outcome", family: str = MEAN, level: float = 0.95) -> Estimate:
        """Return success less another outcome's, paired by episode."""
        pairs = zip(self._of(family), other._of(family), strict=True)
        return mean_of([difference(SUCCESS, a[SUCCESS].T, b[SUCCESS].T, level) for a, b in pairs])

    def p_over(self, other: "Outcome") -> float | None:
        """Return the p-value of no such difference in the mean over families."""
        return p_value(lambda level: self.over(other, level=level))

    def pooled(self, groups: Mapping[str, Bools]) -> Floats:
        """Return success of the episodes of all families that are in a group, (S, n)."""
        return np.hstack([each[SUCCESS][:, groups[family]] for family, each in self.families.items()])

    def _of(self, family: str) -> list[Mapping[str, Floats]]:
        return list(self.families.values()) if family == MEAN else [self.families[family]]


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
        return [content for content in self.others if content != NOTHING and CONTENTS[content].graph != TRUTH]

    @cached_property
    def _p(self) -> dict[Place, float | None]:
        pairs = [(setting, content) for setting in self.points for content in self.others]
        raw = [self.at(setting, content).p_over(self.at(setting, INTENT)) for setting, content in pairs]
        return dict(zip([place(*pair) for pair in pairs], corrected(raw), strict=True))

    def p(self, setting: Setting, content: str) -> float | None:
        """Return the p of a content against intents, by Holm's method for all of the model; of these None."""
        return self._p.get(place(setting, content))

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
    """Return what decides an outcome: the operating point with this content, and the number of vehicles."""
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
        left_out = dict(_unable(list(theirs.values()), [setting.point for setting in distinct(panels)]))
        if INTENT in left_out:
            raise UserError(f"{printable(name)}: {left_out[INTENT]}")
        result.append(Model(name, theirs, left_out))
    return result


def _unable(runs: Sequence[ReplayedRun], points: Sequence[OperatingPoint]) -> Iterator[tuple[str, str]]:
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
    runs: Sequence[ReplayedRun], conditions: Sequence[str], over: Sequence[str], grids: Sequence[str]
) -> list[Panel]:
    """Return the conditions as they are, and each axis in each of them; the usual ones if none is given.

    Raises UserError as `sweep.settings` does, or if there are more grids than axes.
    """
    if len(grids) > len(over):
        raise UserError(f"--grid: {len(grids)} given for {len(over)} of --over; give one for each, in order")
    if conditions or over:
        values = [*grids, *[None] * (len(over) - len(grids))]
        conditions = conditions or [BASE]
        varied = [(c, axis, text) for c in conditions for axis, text in zip(over, values, strict=True)]
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
    points = tuple({
        holding(setting.point, content)
        for panel in panels for setting in panel.settings for content in model.contents
    })  # fmt: skip
    return {
        family: lacking(
            replace(run.spec, points=points),
            run.dataset,
            sorted({*run.dataset.courses(), *run.run.decisions.scenes}),
            run.answered([]),
        )
        for family, run in model.runs.items()
    }


def run_contents(
    swarms: Sequence[Model], panels: Sequence[Panel], seeds: Sequence[int], out: Path, progress: Progress
) -> Study:
    """Play every content at every grid point with every model's runs.

    Raises:
        UserError: the folder holds another study.
        Unanswered: too many questions got no answer; the runs keep all others.
    """
    stated = {
        "sources": [run.manifest() for model in swarms for run in model.runs.values()],
        "contents": list(PLAYED), "seeds": list(seeds),
        "panels": described({panel.name: panel.settings for panel in panels}),
    }  # fmt: skip
    refuse_other(out, "contents", stated)
    points = distinct(panels)
    progress.more(sum(len(model.contents) * len(model.runs) * len(points) for model in swarms))
    results = [_played(model, panels, points, seeds, progress) for model in swarms]
    runs = [run for model in swarms for run in model.runs.values()]
    for run in runs:
        run.settle()
    stated["sources"] = [run.manifest() for run in runs]  # anew, since they state what was left out
    return contents_study(results, seeds, {**stated, "versions": versions()})


def _played(
    model: Model, panels: Sequence[Panel], points: Sequence[Setting], seeds: Sequence[int],
    progress: Progress,
) -> Result:  # fmt: skip
    every = [
        replace(setting, point=holding(setting.point, content))
        for content in model.contents for setting in points
    ]  # fmt: skip
    by_family: dict[Place, dict[str, Mapping[str, Floats]]] = {(s.point, s.vehicles): {} for s in every}
    for family, run in model.runs.items():
        p = run.dataset.scenario.parameters

        def read(part: Decided[Any], lag: int = p.lag_frames, hz: int = p.simulation_hz) -> dict[str, Floats]:
            values = metric_columns(part)
            seconds, at = np.unique(part.result.latency_s, return_inverse=True)
            off = np.array([frames(each, hz) != lag if each == each else np.nan for each in seconds.tolist()])
            return {**values, "off_lag": off[at]}

        for setting, [walk] in zip(every, run.walked(every, seeds, read), strict=True):
            metrics = {SUCCESS: walk.ends[SUCCESS], **by_episode(walk, METRICS)}
            by_family[setting.point, setting.vehicles][family] = metrics
            progress(1)
    return Result(model, panels, {key: Outcome(families) for key, families in by_family.items()})


def witnesses(run: ReplayedRun) -> Ints:
    """Return how many helpers have the danger in sight at the first decision of each episode, (E,).

    `SAFE` without a danger, `HEARD` where it has a radio: its beacons tell of it, whoever sees it.
    """
    forest, scenario = run.dataset.forest, run.dataset.scenario
    counts = []
    for scene in run.dataset.scenes([forest.ids[n] for n in forest.root.tolist()]):
        danger = scene.record.danger
        seen = [any(node.id == danger.vehicle for node in scene.graphs[v].nodes) for v in scene.viewers[1:]]
        heard = radios(scenario, scene.state.episode_seed, danger.sector)["danger_radio"]
        counts.append(SAFE if danger.vehicle is None else HEARD if heard else sum(seen))
    return np.array(counts)


def groups(model: Model) -> dict[str, dict[str, Bools]]:
    """Return by name which episodes of each family, (E,), are in each group: by who sees the danger."""
    counts = {family: witnesses(run) for family, run in model.runs.items()}
    most = max(int(each.max()) for each in counts.values())
    numbers = {"no danger": SAFE, **{f"a danger, seen by {n}": n for n in range(most + 1)}}
    numbers["a danger with a radio"] = HEARD
    named = {
        name: {family: each == n for family, each in counts.items()} for name, n in numbers.items()
    } | {"any danger": {family: each != SAFE for family, each in counts.items()}}  # fmt: skip
    return {name: within for name, within in named.items() if any(map(np.any, within.values()))}


def contents_study(results: Sequence[Result], seeds: Sequence[int], manifest: Mapping[str, Any]) -> Study:
    """Declare the study of what some models' runs came to."""
    points, by_group, figures = points_table(results), groups_table(results), {}
    for n, result in enumerate(results, 1):
        figures[f"cost-{n}"] = fronts(list(_costs(result)))
        curves = _curves(result)
        for first in range(0, len(curves), BESIDE):
            beside = curves[first : first + BESIDE]
            figures[f"along-{n}-{first // BESIDE + 1}"] = along(beside, _marks(beside))
    runs = [run for result in results for run in result.model.runs.values()]
    lags_s = sorted({run.dataset.scenario.parameters.decision_lag_s for run in runs})
    return Study(
        "contents", "Intent or objects?", [text for result in results for text in headline(result)],
        [
            f"{'; '.join(map(_counted, results))}; channel seeds {', '.join(map(str, seeds))}. Stored "
            f"answers are coordinated again with the same random draws at {len(results[0].points)} points "
            "with every content, so differences are paired by episode. 95 % intervals are over episodes; a "
            "mean gives each family the same weight and is about these families alone. Clear: p at most "
            f"{LEVEL:g} by Holm's method for all comparisons of a model with intents.",
            "Bits are of all requests and replies; they add no load to a radio. All that the ego knows was "
            "seen at the decision's start, so its age when the ego acts is the decision's latency. Frozen "
            f"scenes let each action begin {' or '.join(f'{1000 * s:g}' for s in lags_s)} ms after its "
            "decision, whatever it took. Off lag are decisions that would begin in another frame: where a "
            "content has more of them, its success is of an ego that is faster than this one; harness drive "
            "counts that time.",
            "No message can tell what nobody sees: the last table of each model has success by how many "
            "helpers have the danger in sight at the first decision. Where costs are drawn, a line joins the "
            "points of a content that no cheaper one beats. Crosses are the paper's values, of intents.",
        ],
        [table for result in results for table in _tables(result, by_group)],
        {"points": points, "groups": by_group}, manifest, points, figures,
        [*_left_out(results), *(caveat for run in runs for caveat in run.caveats)],
    )  # fmt: skip


def headline(result: Result) -> list[str]:
    """Say which content wins where, and what each costs at the first condition."""
    base, name, intent = result.base, result.model.name, result.at(result.base, INTENT)
    gains = [f"{c} {shown(result.at(base, c).over(intent), sign='+')}" for c in result.sent]
    costs = [
        f"{content} {shown(each.estimate(SUCCESS))} % with {_kbit(each):.1f} kbit and {_age(each):.0f} ms"
        for content in result.model.contents if (each := result.at(base, content))
    ]  # fmt: skip
    return [
        f"{name}, {base.condition}, points over intents: {'; '.join(gains)}. Of {len(result.points)} points, "
        f"clearly better than intents: {_clear(result, True)}; clearly worse: {_clear(result, False)}.",
        f"{name}, success, bits of an episode, and time until the ego acts: {', '.join(costs)}; "
        f"n = {_episodes(result.model)} episodes.",
    ]


def _clear(result: Result, better: bool) -> str:
    """Say where each content is clearly better than intents, or clearly worse."""
    texts = []
    for content in result.sent:
        points, values = set[Place](), dict[str, list[str]]()
        for panel in result.panels:
            for setting in panel.settings:
                p = result.p(setting, content)
                gain = result.at(setting, content).over(result.at(setting, INTENT)).value
                if p is not None and p <= LEVEL and (gain > 0) == better:
                    points.add(place(setting, content))
                    if panel.axis:
                        values.setdefault(panel.axis, []).append(_value(setting))
        where = "; ".join(f"{axis} {', '.join(each)}" for axis, each in values.items())
        if points:
            texts.append(f"{content} at {len(points)}{f' ({where})' if where else ''}")
    return " and ".join(texts) or "none"


def _value(setting: Setting) -> str:
    return setting.value if isinstance(setting.value, str) else f"{setting.value:g}"


def _episodes(model: Model) -> int:
    return sum(run.episodes for run in model.runs.values())


def _kbit(outcome: Outcome) -> float:
    return outcome.estimate(BITS).value / 1000


def _age(outcome: Outcome) -> float:
    return outcome.estimate(LATENCY).value


def _counted(result: Result) -> str:
    families = ", ".join(f"{family} {run.episodes}" for family, run in result.model.runs.items())
    return f"{result.model.name}: n = {_episodes(result.model)} episodes ({families})"


def _left_out(results: Sequence[Result]) -> list[str]:
    return [
        f"{printable(result.model.name)}: {content} is left out: {why}"
        for result in results for content, why in result.model.left_out.items()
    ]  # fmt: skip


def _tables(result: Result, by_group: "pd.DataFrame") -> Iterator[Table]:
    yield _at_base(result)
    yield _at_equal(result, "bits", _kbit)
    yield _at_equal(result, "age", _age)
    if len(result.families) > 1:
        yield _by_family(result)
    yield from (_along(result, panel) for panel in result.panels if panel.axis)
    yield _by_group(result, by_group[by_group.model == result.model.name])


def _over(result: Result, setting: Setting, content: str) -> str:
    """Return success over intents as a cell, bold where it is clear; empty for intents."""
    if content == INTENT:
        return ""
    gain = result.at(setting, content).over(result.at(setting, INTENT))
    p = result.p(setting, content)
    return strong(shown(gain, sign="+"), p is not None and p <= LEVEL)


def _at_base(result: Result) -> Table:
    rows = []
    for content in result.model.contents:
        outcome = result.at(result.base, content)
        late, off_lag = (f"{100 * outcome.estimate(name).value:.1f}" for name in (LATE, OFF_LAG))
        p = "" if content == INTENT else p_cell(result.p(result.base, content))
        rows.append((
            content, shown(outcome.estimate(SUCCESS)), _over(result, result.base, content), p,
            f"{_kbit(outcome):.2f}", f"{_age(outcome):.1f}", late, off_lag,
        ))  # fmt: skip
    return Table(
        f"{result.model.name}, {result.base.condition}",
        ("content", "success %", "over intents", "p", "kbit", "age, ms", "late %", "off lag %"), rows,
        "Over intents: in points, bold where it is clear. kbit: of all requests and replies of an episode. "
        "Age: of what the ego knows when it acts. Late: decisions longer than the window.",
        terminal=(0, 1, 2, 4, 5, 6),
    )  # fmt: skip


def _at_equal(result: Result, title: str, cost: Callable[[Outcome], float]) -> Table:
    """Of settings in the first condition that cost no more than intents in it, show each content's best."""
    intent = result.at(result.base, INTENT)
    settings = {"as it is": result.base} | {
        f"{panel.axis} {_value(setting)}": setting
        for panel in result.panels for setting in panel.settings
        if setting.condition == result.base.condition and panel.axis in SPENDING
    }  # fmt: skip
    rows = []
    for content in result.model.contents:
        outcomes = [(result.at(setting, content), name) for name, setting in settings.items()]
        within = [each for each in outcomes if cost(each[0]) <= cost(intent) + 1e-9]
        if not within:
            rows.append((content, "none", "", "", "", ""))
            continue
        best, name = max(within, key=lambda each: each[0].estimate(SUCCESS).value)
        gain = "" if best is intent else shown(best.over(intent), sign="+")
        costs = (f"{_kbit(best):.2f}", f"{_age(best):.1f}")
        rows.append((content, name, shown(best.estimate(SUCCESS)), gain, *costs))
    return Table(
        f"{result.model.name}, {result.base.condition}: at the {title} of intents",
        ("content", "setting", "success %", "over intents", "kbit", "age, ms"), rows,
        f"Of the settings of {' and '.join(SPENDING)} that cost no more than intents with the condition as "
        "it is, the best of each content; chosen on these episodes, which flatters it.",
    )  # fmt: skip


def _by_family(result: Result) -> Table:
    contents = result.model.contents
    rows = []
    for family in result.families:
        outcomes = {content: result.at(result.base, content) for content in contents}
        gains = (shown(outcomes[c].over(outcomes[INTENT], family), sign="+") for c in result.sent)
        scores = (shown(outcome.estimate(SUCCESS, family)) for outcome in outcomes.values())
        rows.append((family, *scores, *gains))
    heads = (
        "family",
        *(f"{content}, %" for content in contents),
        *(f"{c} over intents" for c in result.sent),
    )
    note = "Differences are in points, paired by episode."
    title = f"{result.model.name}, {result.base.condition}: by family"
    return Table(title, heads, rows, note, total=True)


def _along(result: Result, panel: Panel) -> Table:
    contents, rows = result.model.contents, []
    theirs = _theirs(panel.axis)
    for setting in panel.settings:
        outcomes = [result.at(setting, content) for content in contents]
        rows.append((
            _value(setting), *(shown(outcome.estimate(SUCCESS)) for outcome in outcomes),
            *(_over(result, setting, content) for content in result.sent),
            *([theirs.get(setting.value, "")] if theirs else []),
        ))  # fmt: skip
    heads = (
        panel.axis, *(f"{content}, %" for content in contents), *(f"{c} over intents" for c in result.sent),
        *(["the paper, %"] if theirs else []),
    )  # fmt: skip
    note = "Differences are in points, bold where they are clear. The paper's value is of intents."
    return Table(f"{result.model.name}, {panel.name}", heads, rows, note, folded=True)


def _by_group(result: Result, rows: "pd.DataFrame") -> Table:
    contents, cells = result.model.contents, list[Sequence[str]]()
    for group, each in rows.groupby("group", sort=False):
        of = each.set_index("content")
        scores = [percent(of.loc[c], "success", "success_low", "success_high") for c in contents]
        gains = [
            percent(of.loc[c], "over_intent", "over_intent_low", "over_intent_high") for c in result.sent
        ]
        cells.append((str(group), str(of.n.iloc[0]), *scores, *gains))
    heads = (
        "group",
        "n",
        *(f"{content}, %" for content in contents),
        *(f"{c} over intents" for c in result.sent),
    )
    title = f"{result.model.name}, {result.base.condition}: by who sees the danger"
    return Table(title, heads, cells, "Episodes of all families together; n is their number.")


def _costs(result: Result) -> Iterator[tuple[str, str, list[Steps]]]:
    """Yield success against bits, and against age, of all points, a front a content."""
    costs = (("bits of an episode, kbit", _kbit), ("age when the ego acts, ms", _age))
    for title, cost in costs:
        steps = []
        for n, content in enumerate(result.model.contents):
            look: dict[str, Any] = {"color": COLOURS[n % len(COLOURS)]}
            places = sorted(
                (cost(outcome), -100 * outcome.estimate(SUCCESS).value)
                for setting in result.points if (outcome := result.at(setting, content))
            )  # fmt: skip
            x, y = np.array(places).T * [[1], [-1]]
            best = y >= np.maximum.accumulate(y)
            marker = look | {"marker": MARKERS[n % len(MARKERS)], "markersize": 4}
            steps += [Steps(content, x, y, marker | {"linestyle": ""}), Steps("", x[best], y[best], look)]
        yield result.model.name, title, steps


def _curves(result: Result) -> "list[pd.DataFrame]":
    """Return a part of a summary for each panel, as figures take it: a content in place of a condition."""
    import pandas as pd

    return [
        pd.DataFrame([
            {
                "source": result.model.name, "panel": PAPER.get(panel.axis, (panel.axis,))[0],
                "condition": content, "variable": panel.axis, "value": setting.value, "metric": SUCCESS,
                "mean": e.value, "ci_low": e.low, "ci_high": e.high, "interval": "episodes",
            }
            for content in result.model.contents for setting in panel.settings
            if (e := result.at(setting, content).estimate(SUCCESS))
        ])
        for panel in result.panels if panel.axis
    ]  # fmt: skip


def _theirs(axis: str) -> dict[Any, str]:
    """Return the paper's success of intents by the value of an axis, in percent."""
    panel, shift = PAPER.get(axis, ("", 0.0))
    return {
        float(row["value"]) + shift: row["paper_value"]
        for row in paper_numbers()
        if row["panel"] == panel and row["metric"] == "success" and row["paper_value"]
    }


def _marks(curves: "Sequence[pd.DataFrame]") -> "pd.DataFrame":
    """Return the paper's success of intents as figures take it, as far as panels have its values."""
    import pandas as pd

    return pd.DataFrame([
        {"panel": curve.panel[0], "metric": SUCCESS, "value": value, "low": float(text), "high": float(text)}
        for curve in curves for value, text in _theirs(curve.variable[0]).items()
        if curve.value.min() <= value <= curve.value.max()
    ], columns=["panel", "metric", "value", "low", "high"])  # fmt: skip


def points_table(results: Sequence[Result]) -> "pd.DataFrame":
    """Return a row for each model, grid point, content and family, with the mean over families."""
    import pandas as pd

    def row(result: Result, panel: Panel, setting: Setting, content: str, family: str) -> dict[str, Any]:
        outcome, intent = result.at(setting, content), result.at(setting, INTENT)
        last = family == result.families[-1]
        return {
            "model": result.model.name, "family": family, "condition": setting.condition,
            "variable": panel.axis, "value": setting.value, "content": content,
            **_success(outcome.estimate(SUCCESS, family), outcome.over(intent, family)),
            "p_holm": result.p(setting, content) if last else None,
            **{
                key: value
                for name in METRICS for key, value in _ends(name, outcome.estimate(name, family)).items()
            },
        }  # fmt: skip

    return pd.DataFrame([
        row(result, panel, setting, content, family)
        for result in results for panel in result.panels for setting in panel.settings
        for content in result.model.contents for family in result.families
    ])  # fmt: skip


def groups_table(results: Sequence[Result]) -> "pd.DataFrame":
    """Return a row for each model, group of episodes and content, at the first condition."""
    import pandas as pd

    rows = []
    for result in results:
        for name, within in groups(result.model).items():
            intent = result.at(result.base, INTENT).pooled(within)
            for content in result.model.contents:
                success = result.at(result.base, content).pooled(within)
                rows.append({
                    "model": result.model.name, "condition": result.base.condition, "group": name,
                    "content": content,
                    **_success(over_episodes(SUCCESS, success), difference(SUCCESS, success.T, intent.T)),
                })  # fmt: skip
    return pd.DataFrame(rows)


def _success(e: Estimate, gain: Estimate) -> dict[str, Any]:
    return {**_ends("success", e), "n": e.n, **_ends("over_intent", gain)}


def _ends(name: str, e: Estimate) -> dict[str, float]:
    return {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}
