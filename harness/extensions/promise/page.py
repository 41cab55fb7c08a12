"""Say in sentences and tables what a model may promise, and what the promise costs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from harness.coordination.operating_point import OperatingPoint
from harness.core.figures import DASH, PERCENT, interval_of
from harness.core.seeds import seeds_text
from harness.core.versions import versions
from harness.extensions.promise.outcomes import (
    WORDS,
    Level,
    Played,
    Result,
    is_binary,
    percent,
    unable,
)
from harness.extensions.promise.risk import p_values
from harness.extensions.promise.study import manifest_of, seed_range
from harness.report.document import Table
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, ends

if TYPE_CHECKING:
    import pandas as pd

BLIND = "blind"  # in place of a run, of egos that look at nothing
THRESHOLDS = ("", "tau", "tau_nats", "careful_nats")  # as typed, or nothing
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


def promise_study(result: Result, out_runs: Sequence[ReplayedRun]) -> Study:
    """Return the study (sentences, tables) of what a model may promise; `out_runs` are all runs."""
    data = tables(result)
    n, seeds = result.units.shape[1], ", ".join(map(str, result.seeds))
    first, last = seed_range(result.tune.run)
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
    shares = ", ".join(percent(level.at_most) for level in result.levels)
    counts = ", ".join(str(level.needed) for level in result.levels)
    return (
        f"To promise {shares} % (delta = {percent(result.delta)} %) takes {counts} tune layouts "
        f"without harm; here are {result.units.shape[1]}."
    )


def sentence(result: Result, level: Level) -> str:
    """Return what a level promises and costs, on report layouts, or that it cannot be promised."""
    if level.chosen is None:
        return f"{unable(result, level)}; {_beside(result, level)}."
    report, point = result.report, level.chosen
    base = next(each for each in result.conditions if each.name == point.name)
    before, after = report.outcomes[base], report.outcomes[point]
    change = report.success_rule.difference(after.success, before.success)
    requests = after.costs["requests"] - before.costs["requests"]
    late_ms = after.costs["latency_ms"] - before.costs["latency_ms"]
    careful = " (always careful)" if is_always(point) else ""
    kept = "" if report.harm(point).low <= level.at_most else ", where it is not kept"
    return (
        f"{WORDS[result.harm].capitalize()} ≤ {percent(level.at_most)} % costs {requests:+.1f} "
        f"requests, {late_ms:+.1f} ms and {interval_of(change, sign='+')} "
        f"points of {report.success_rule.words}{careful}: {interval_of(report.harm(point))} % on "
        f"report layouts{kept}, by {typed(point)}; {_beside(result, level)}."
    )


def _beside(result: Result, level: Level) -> str:
    """Return in words what promises a level without a model, and its success on report layouts."""
    if level.blind is None:
        return "no blind ego can promise it"
    success = PERCENT.text(result.report.success(level.blind).value)
    return f"blind, {level.blind} keeps it at {success} success"


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


def typed(point: OperatingPoint) -> str:
    """Return the text of a condition with its thresholds, as it is typed."""
    name, _, rest = point.name.partition(":")
    settings = [text for text in rest.split(",") if text.partition("=")[0] not in THRESHOLDS]
    settings.append(f"tau={point.setting('tau_nats'):g}")
    if (careful_nats := point.setting("careful_nats")) is not None:
        settings.append(f"careful_nats={careful_nats:g}")
    return f"{name}:{','.join(settings)}"


def _table(result: Result, played: Played) -> Table:
    inside = played is result.report
    rows = list[list[str]]()
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
    for name in played.blind:
        on_tune = result.tune.outcomes.get(name)
        harm, success = interval_of(played.harm(name)), interval_of(played.success(name))
        tune_harm = PERCENT.text(on_tune.harm.mean()) if on_tune else DASH
        rows.append([name, DASH, DASH, harm, tune_harm, success, *[DASH] * 4])
    return Table(
        f"{played.run.name} on {played.run.dataset.name}"
        f"{'' if inside else ': outside of every promise'}",
        HEADS,
        rows,
        "Nats: tau, above which the ego asks, and careful, from which it takes the first action. "
        f"Harm is the share of {WORDS[result.harm]}. Requests are an episode's, ms a decision's; "
        "careful %: decisions with the first action, asked %: that ask. The last rows "
        "are of egos that look at nothing; what uniform comes to is computed by the trees.",
        terminal=[0, 1, 2, 3, 5, 6, 7],
    )


def tables(result: Result) -> "dict[str, pd.DataFrame]":
    """Return the data frames `promise` and `settings`, by these names, to write as files.

    `promise` has a row for each shown setting and each run, and for each ego that looks at nothing,
    whose run is `BLIND`; `settings` one for each setting that
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
                **_estimates(played, point),
            }
            base = next(each for each in result.conditions if each.name == point.name)
            outcomes, rule = played.outcomes, played.success_rule
            over = rule.difference(outcomes[point].success, outcomes[base].success)
            row |= {f"success_over_{key}": value for key, value in ends(over).items()}
            rows.append({**row, **outcomes[point].costs})
        for name in played.blind:
            of_levels = played is result.report and name in [each.blind for each in result.levels]
            row = {"run": BLIND, "dataset": played.run.dataset.name, "promised": of_levels}
            rows.append({**row, "setting": name, **_estimates(played, name)})
    means, n = result.units.mean(axis=1), result.units.shape[1]
    for place, point in enumerate(result.grid.points):
        outcome = result.tune.outcomes[point]
        row = {**_thresholds(point), "harm": means[place], "n": n, **outcome.costs}
        row["success"] = result.tune.success_rule.mean(outcome.success)
        for level in result.levels:
            p = p_values(means[place], n, level.at_most, is_binary(result))
            row[f"p_{percent(level.at_most)}"] = float(p)
        settings.append(row)
    return {"promise": pd.DataFrame(rows), "settings": pd.DataFrame(settings)}


def _estimates(played: Played, setting: OperatingPoint | str) -> dict[str, Any]:
    row = dict[str, Any]()
    estimates = {"harm": played.harm(setting), "success": played.success(setting)}
    for name, estimate in estimates.items():
        row |= {f"{name}_{key}": value for key, value in ends(estimate).items()}
    return row


def _thresholds(point: OperatingPoint) -> dict[str, Any]:
    names = ("tau_nats", "careful_nats")
    return {"condition": point.name, **{name: point.setting(name) for name in names}}
