"""The page of `harness study contents`:
at equal bits and age, along axes, and by who sees the danger.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.contents import INTENT
from harness.core.errors import printable
from harness.core.figures import amount, interval_of
from harness.core.multiplicity import LEVEL
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.extensions.contents.study import (
    BITS,
    LATE,
    METRICS,
    OFF_LAG,
    Model,
    Outcome,
    Panel,
    Place,
    Result,
    groups,
    manifest_of,
    place,
)
from harness.report.document import Table, strong
from harness.report.drawing.colours import COLOURS, MARKERS
from harness.runs.estimates import difference, over_episodes
from harness.runs.headline import SUCCESS
from harness.runs.metric_names import LATENCY
from harness.runs.metrics import entry
from harness.studies.axes import Setting
from harness.studies.figures.described import Draws, Steps
from harness.studies.paper_numbers import paper_numbers
from harness.studies.study import Study, p_cell, percent

if TYPE_CHECKING:
    import pandas as pd

BESIDE = 3  # panels of a figure
SPENDING = ("tau_nats", "max_helpers")  # axes that vary the bits
# The paper's panels by axis, and what is added to their values: its N counts the ego.
PAPER = {"loss": ("loss", 0.0), "tau_nats": ("tau", 0.0), "max_helpers": ("size", -1.0)}


def contents_study(results: Sequence[Result], seeds: Sequence[int]) -> Study:
    """Return the study of what messages should hold, whose tables and pictures make its page.

    `results` has the outcomes of one model an item, and `seeds` are the keys of the channel's
    random draws.
    """
    manifest = manifest_of([result.model for result in results], results[0].panels, seeds)
    points, by_group = points_table(results), groups_table(results)
    runs = [run for result in results for run in result.model.runs.values()]
    count = amount(len(results[0].points), "point")
    lags_s = sorted({run.dataset.scenario.parameters.decision_lag_s for run in runs})
    return Study(
        "contents",
        "Intent or objects?",
        [text for result in results for text in headline(result)],
        [
            f"{'; '.join(map(_counted, results))}; channel seeds {', '.join(map(str, seeds))}. "
            "Stored answers are coordinated again with the same random draws at "
            f"{count} with every content, so differences are paired by "
            "episode. 95 % intervals are over episodes; a mean gives each family the same weight "
            f"and is about these families alone. Clear: p at most {LEVEL:g} by Holm's method for "
            "all comparisons of a model with intents.",
            "Bits are of all messages; they add no load to a radio. All that the ego "
            "knows was seen at the decision's start, so its age when the ego acts is the "
            "decision's latency. Frozen scenes let each action begin "
            f"{' or '.join(f'{1000 * s:g}' for s in lags_s)} ms after its decision, whatever it "
            "took. Off lag are decisions that would begin in another frame: where a content has "
            "more of them, its success is of an ego that is faster than this one; harness drive "
            "counts that time.",
            "No message can tell what nobody sees: the last table of each model has success by "
            "how many helpers have the danger in sight at the first decision. Where costs are "
            "drawn, a line joins the points of a content that no cheaper one beats. Crosses are "
            "the paper's values, of intents and plain success.",
        ],
        [table for result in results for table in _tables(result, by_group)],
        {"points": points, "groups": by_group},
        {**manifest, "versions": versions()},
        points,
        lambda draws: _figures(draws, results),
        [*_left_out(results), *(caveat for run in runs for caveat in run.caveats)],
    )


def _figures(draws: Draws[Any], results: Sequence[Result]) -> dict[str, Any]:
    figures = {}
    for n, result in enumerate(results, 1):
        figures[f"cost-{n}"] = draws.fronts(list(_costs(result)), result.words)
        curves, colours = _curves(result), dict(zip(result.model.contents, cycle(COLOURS)))
        for first in range(0, len(curves), BESIDE):
            beside = curves[first : first + BESIDE]
            drawn = draws.along(beside, _marks(beside), colours)
            figures[f"along-{n}-{first // BESIDE + 1}"] = drawn
    return figures


def headline(result: Result) -> list[str]:
    """Return sentences on what messages gain, by what they hold: intents, words, objects or both.

    An intent is a vehicle's probabilities of the ego's actions. `result` has one model's outcomes.
    The sentences state the success with each content over that with intents, the bits that messages
    take, and the time until the ego acts.
    """
    base, name, intent = result.base, result.model.name, result.at(result.base, INTENT)
    gains, costs = list[str](), list[str]()
    for content in result.sent:
        gains.append(f"{content} {interval_of(result.at(base, content).over(intent), sign='+')}")
    for content in result.model.contents:
        outcome = result.at(base, content)
        cost = f"{_kbit(outcome):.1f} kbit and {_age(outcome):.0f} ms"
        costs.append(f"{content} {interval_of(outcome.success)} % with {cost}")
    return [
        f"{name}, {base.condition}, points of {result.words} over intents: {'; '.join(gains)}. "
        f"Of {amount(len(result.points), 'point')}, "
        f"clearly better than intents: {_clear(result, True)}; clearly worse: "
        f"{_clear(result, False)}.",
        f"{name}, {result.words}, bits of an episode, and time until the ego acts: "
        f"{', '.join(costs)}; n = {_episodes(result.model)} episodes.",
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
        for result in results
        for content, why in result.model.left_out.items()
    ]


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
    return strong(interval_of(gain, sign="+"), p is not None and p <= LEVEL)


def _at_base(result: Result) -> Table:
    halves = entry(result.headline_metric).halves
    rows = []
    for content in result.model.contents:
        outcome = result.at(result.base, content)
        gain = _over(result, result.base, content)
        p = "" if content == INTENT else p_cell(result.p(result.base, content))
        costs = (f"{_kbit(outcome):.2f}", f"{_age(outcome):.1f}")
        late = f"{100 * outcome.estimate(LATE).value:.1f}"
        off_lag = f"{100 * outcome.estimate(OFF_LAG).value:.1f}"
        of_halves = [interval_of(outcome.estimate(half)) for half in halves]
        rows.append(
            (content, interval_of(outcome.success), gain, p, *costs, late, off_lag, *of_halves)
        )
    heads = ["content", f"{result.words} %", "over intents", "p"]
    heads += ["kbit", "age, ms", "late %", "off lag %"]
    if halves:
        heads += ["with a danger %", "without %"]
    return Table(
        f"{result.model.name}, {result.base.condition}",
        heads,
        rows,
        "Over intents: in points, bold where it is clear. kbit: of all requests and replies of an "
        "episode. Age: of what the ego knows when it acts. Late: decisions longer than the window.",
        terminal=(0, 1, 2, 4, 5, 6),
    )


def _at_equal(result: Result, title: str, cost: Callable[[Outcome], float]) -> Table:
    """Return a row for each content with its best setting in the first condition,
    of those that cost no more than intents in it.
    """
    intent = result.at(result.base, INTENT)
    settings = {"as it is": result.base}
    for panel in result.panels:
        for setting in panel.settings:
            if setting.condition == result.base.condition and panel.axis in SPENDING:
                settings[f"{panel.axis} {_value(setting)}"] = setting
    rows = []
    for content in result.model.contents:
        affordable = {}
        for name, setting in settings.items():
            outcome = result.at(setting, content)
            if cost(outcome) <= cost(intent) + 1e-9:
                affordable[name] = outcome
        if not affordable:
            rows.append((content, "none", "", "", "", ""))
            continue
        best_name = max(affordable, key=lambda name: affordable[name].success.value)
        best = affordable[best_name]
        gain = "" if best is intent else interval_of(best.over(intent), sign="+")
        costs = (f"{_kbit(best):.2f}", f"{_age(best):.1f}")
        rows.append((content, best_name, interval_of(best.success), gain, *costs))
    return Table(
        f"{result.model.name}, {result.base.condition}: at the {title} of intents",
        ("content", "setting", f"{result.words} %", "over intents", "kbit", "age, ms"),
        rows,
        f"Of the settings of {' and '.join(SPENDING)} that cost no more than intents with the "
        "condition as it is, the best of each content; chosen on these episodes, which flatters "
        "it.",
    )


def _by_family(result: Result) -> Table:
    contents = result.model.contents
    rows = []
    for family in result.families:
        outcomes = {content: result.at(result.base, content) for content in contents}
        metric, intent = result.headline_metric, outcomes[INTENT]
        scores = [interval_of(outcome.estimate(metric, family)) for outcome in outcomes.values()]
        gains = [interval_of(outcomes[c].over(intent, family), sign="+") for c in result.sent]
        rows.append((family, *scores, *gains))
    heads = (
        "family",
        *(f"{content}, %" for content in contents),
        *(f"{c} over intents" for c in result.sent),
    )
    note = "Differences are in points, paired by episode."
    title = f"{result.model.name}, {result.base.condition}: {result.words} by family"
    return Table(title, heads, rows, note, total=True)


def _along(result: Result, panel: Panel) -> Table:
    contents, rows = result.model.contents, []
    of_paper = _of_paper(panel.axis)
    for setting in panel.settings:
        row = [_value(setting)]
        row += [interval_of(result.at(setting, content).success) for content in contents]
        row += [_over(result, setting, content) for content in result.sent]
        if of_paper:
            row.append(of_paper.get(setting.value, ""))
        rows.append(row)
    heads = [panel.axis, *(f"{content}, %" for content in contents)]
    heads += [f"{content} over intents" for content in result.sent]
    if of_paper:
        heads.append("the paper, %")
    note = (
        "Differences are in points, bold where they are clear. The paper's value is of intents and "
        "of plain success, in scenes of its own."
    )
    return Table(
        f"{result.model.name}, {panel.name}: {result.words}", heads, rows, note, folded=True
    )


def _by_group(result: Result, rows: "pd.DataFrame") -> Table:
    contents, cells = result.model.contents, list[Sequence[str]]()
    for group, each in rows.groupby("group", sort=False):
        of = each.set_index("content")
        scores = [percent(of.loc[c], "success", "success_low", "success_high") for c in contents]
        gains = [
            percent(of.loc[c], "over_intent", "over_intent_low", "over_intent_high")
            for c in result.sent
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
            outcomes = [result.at(setting, content) for setting in result.points]
            # The cheapest first, of equals the most successful.
            places = sorted((cost(each), -100 * each.success.value) for each in outcomes)
            x, y = np.array(places).T * [[1], [-1]]
            best = y >= np.maximum.accumulate(y)
            colour, marker = COLOURS[n % len(COLOURS)], MARKERS[n % len(MARKERS)]
            steps.append(Steps(content, x, y, colour, "", marker))
            steps.append(Steps("", x[best], y[best], colour))
        yield result.model.name, title, steps


def _curves(result: Result) -> "list[pd.DataFrame]":
    """Return the curves of each panel with an axis in the columns of a sweep's summary,
    with the content as condition.
    """
    import pandas as pd

    curves = []
    for panel in result.panels:
        if not panel.axis:
            continue
        rows = []
        for content in result.model.contents:
            for setting in panel.settings:
                success = result.at(setting, content).success
                row = {
                    "source": result.model.name,
                    "panel": PAPER.get(panel.axis, (panel.axis,))[0],
                    "condition": content,
                    "variable": panel.axis,
                    "value": setting.value,
                    "metric": result.headline_metric,
                    "mean": success.value,
                    "ci_low": success.low,
                    "ci_high": success.high,
                    "interval": "episodes",
                }
                rows.append(row)
        curves.append(pd.DataFrame(rows))
    return curves


def _of_paper(axis: str) -> dict[Any, str]:
    """Return the paper's success of intents by the value of an axis, in percent."""
    panel, shift = PAPER.get(axis, ("", 0.0))
    values = {}
    for row in paper_numbers():
        if row["panel"] == panel and row["metric"] == "success" and row["paper_value"]:
            values[float(row["value"]) + shift] = row["paper_value"]
    return values


def _marks(curves: "Sequence[pd.DataFrame]") -> "pd.DataFrame":
    """Return the paper's success of intents as figures take it,
    as far as panels have its values.
    """
    import pandas as pd

    rows = []
    for curve in curves:
        for value, percent_text in _of_paper(curve.variable[0]).items():
            if curve.value.min() <= value <= curve.value.max():
                success = float(percent_text)
                rows.append((curve.panel[0], SUCCESS, value, success, success))
    return pd.DataFrame(rows, columns=["panel", "metric", "value", "low", "high"])


def points_table(results: Sequence[Result]) -> "pd.DataFrame":
    """Return the outcomes as a table: a row for each model, grid point, content and family.

    A content is what messages hold, such as `intent` (a vehicle's probabilities of actions), and a
    family the scenes of one scenario, or `mean` of several. A grid point is a `condition` (settings
    of radio, asking and fusion) with one setting (`variable`) at a `value`. Columns of figures,
    such as `success` (a share) and `bits_per_episode`, have the ends of their 95 % interval beside
    them, in `_low` and `_high`; `over_intent` is success less that with intents.
    """
    import pandas as pd

    rows = []
    for result in results:
        for panel in result.panels:
            for setting in panel.settings:
                for content in result.model.contents:
                    for family in result.families:
                        rows.append(_points_row(result, panel, setting, content, family))
    return pd.DataFrame(rows)


def _points_row(
    result: Result, panel: Panel, setting: Setting, content: str, family: str
) -> dict[str, Any]:
    outcome, intent = result.at(setting, content), result.at(setting, INTENT)
    success = outcome.estimate(SUCCESS, family)
    gain = outcome.over(intent, family, metric=SUCCESS)
    p = result.p(setting, content) if family == result.families[-1] else None
    row = {
        "model": result.model.name,
        "family": family,
        "condition": setting.condition,
        "variable": panel.axis,
        "value": setting.value,
        "content": content,
        **_success(success, gain),
        **_balanced(result, outcome, intent, family),
        "lead": result.headline_metric,
        "p_holm": p,
    }
    for name in METRICS:
        row |= _ends(name, outcome.estimate(name, family))
    return row


def groups_table(results: Sequence[Result]) -> "pd.DataFrame":
    """Return success by who sees the danger: a row for each model, group of episodes and content.

    The danger is the vehicle that the ego would meet if it drove on. A group has the episodes in
    which so many helpers see it, and a content is what messages hold. All are under the first
    condition (settings of radio, asking and fusion) as it is. `success` is a share, and
    `over_intent` that less the share with intents, with 95 % intervals in `_low` and `_high`; `n`
    counts episodes.
    """
    import pandas as pd

    rows = []
    for result in results:
        for name, within in groups(result.model).items():
            outcome = result.at(result.base, INTENT)
            intent, clusters = outcome.pooled(within), outcome.pooled_clusters(within)
            for content in result.model.contents:
                success = result.at(result.base, content).pooled(within)
                gain = difference(SUCCESS, [(success.T, intent.T)], clusters=clusters)
                row = {
                    "model": result.model.name,
                    "condition": result.base.condition,
                    "group": name,
                    "content": content,
                    **_success(over_episodes(SUCCESS, success, clusters), gain),
                }
                rows.append(row)
    return pd.DataFrame(rows)


def _balanced(result: Result, outcome: Outcome, intent: Outcome, family: str) -> dict[str, Any]:
    """Return balanced success, its halves and its gain over intents as columns of a row;
    none where plain success is the headline metric.
    """
    if result.headline_metric == SUCCESS:
        return {}
    columns: dict[str, Any] = {}
    for name in result.successes:
        columns |= _ends(name.removesuffix("_rate"), outcome.estimate(name, family))
    return columns | _ends("balanced_over_intent", outcome.over(intent, family))


def _success(e: Estimate, gain: Estimate) -> dict[str, Any]:
    return {**_ends("success", e), "n": e.n, **_ends("over_intent", gain)}


def _ends(name: str, e: Estimate) -> dict[str, float]:
    return {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}
