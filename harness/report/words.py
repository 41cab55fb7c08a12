"""Numbers and findings in the words of the report."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from harness.core.covariate import worth
from harness.core.errors import printable
from harness.core.figures import POINTS, within
from harness.core.figures import shown as shown_estimate
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate
from harness.report.caveats import doubted
from harness.runs import metrics
from harness.runs.folder import Run
from harness.runs.leading import ANY_TIME, IN_WORDS, best_of, lead_of
from harness.runs.metrics import ADJUSTED, BASELINE, GAINS, LATENCY, SUCCESS, entry, written
from harness.runs.records import Score
from harness.runs.success import half_difference, mean_difference, p_of_mean
from harness.runs.suite import SuiteRun, plays

# Layouts from which on a corrected figure is shown beside the plain one, whatever both are:
# intervals of so many hold the truth in 94 % of studies or more, plain and balanced
# (`benchmarks/difficulty.py`).
SHOWN_FROM = 40


def shown(score: Score) -> dict[str, str]:
    """Return value, interval and n of a score, for a cell of the table."""
    unit = entry(score.metric).unit
    n = f"n = {score.n} {score.interval}"
    if score.n_excluded:
        n += f", {score.n_excluded} excluded"
    return {"value": unit.text(score.value), "interval": unit.ends(score), "n": n}


def cell(score: Score | None) -> Markup:
    """Return value and interval of a score as a cell of a page; a dash where there is none."""
    if score is None:
        return Markup("–")
    text = shown(score)
    small = Markup("<small>{}</small>").format(text["interval"]) if text["interval"] else ""
    return Markup("<strong>{}</strong>{}").format(text["value"], small)


def headline(run: Run | SuiteRun) -> str:
    """Return the result in one short sentence:
    the best condition, and the one without V2V beside it.
    """
    model = f"{run.manifest.variant.model}{run.manifest.variant.mix}"
    best, base = compared(run)
    if not best:
        return f"{model} on {run.source}: the run has no success rate."
    lead = lead_of(run)
    families = f" (mean over {len(run.runs)} families)" if isinstance(run, SuiteRun) else ""
    value = _shown(run, best, lead)
    if not base:
        several = len(run.conditions) > 1
        of = " without a warning" if doubted(*_runs(run)) else ""
        what = "clears {} of the episodes" if lead == SUCCESS else "has {} balanced success"
        text = f"Under {best}, {model} {what.format(value)}{families}"
        if halves := entry(lead).halves:
            text += ": {} with a danger, {} without".format(
                *(_shown(run, best, half) for half in halves)
            )
        return text + (f", and no other condition{of} does better." if several else ".")
    pairs, p = plays(_runs(run), lead).pairs(best, base), p_values(run, base)
    corrected = dict(zip(p, holm(list(p.values())), strict=True))
    clear = judged(mean_difference(pairs), corrected[best])
    if lead == SUCCESS:
        text = f"Under {best}, {model} clears {value} of the episodes{families}; under {base}, "
        return f"{text}{_shown(run, base, lead)}: {clear}."
    shares = [_shown(run, best, half) for half in entry(lead).halves]
    changes = [shown_change(half_difference(pairs, dangerous)) for dangerous in (True, False)]
    return (
        f"Under {best}, {model} succeeds in {shares[0]} of the layouts with a danger, {changes[0]} "
        f"against {base}, and in {shares[1]} of those without, {changes[1]}{families}; the mean of "
        f"both is {value}, {clear}."
    )


def shown_change(change: Estimate) -> str:
    """Write a difference of success with its interval: `+7.7 [+3.1, +12.4] points`."""
    return f"{shown_estimate(change, POINTS, '+')} points"


def judged(change: Estimate, p: float) -> str:
    """Write a difference of success, and say that it is clear,
    or what is excluded where it is not.
    """
    text = shown_change(change)
    if math.isnan(change.low):
        return f"{text}, too few episodes for an interval"
    unclear = f"not clear, but within {within(change.low, change.high)}"
    return f"{text}, {'a clear difference' if p <= LEVEL else unclear}"


def compared(run: Run | SuiteRun) -> tuple[str, str]:
    """Return the best condition, and the one that it is held against:
    the one without V2V, or the worst.

    Empty where there is none.
    """
    lead = lead_of(run)
    scores = {c: s.value or 0.0 for c in run.conditions if (s := run.score(c, lead)) is not None}
    radios = {c["name"] for c in run.manifest.conditions if c.get("profile") is not None}
    best = best_of(scores, radios, doubted(*_runs(run)))
    alone = [
        c["name"]
        for c in run.manifest.conditions
        if c.get("profile") is None and c["name"] in scores
    ]
    base = alone[0] if alone else min(scores, key=lambda c: scores[c], default="")
    return best, "" if base == best else base


def figures(run: Run) -> list[dict[str, str]]:
    """Return the few numbers of a run that are read first,
    each with what it is and its interval.
    """
    best, base = compared(run)
    lead = lead_of(run)
    better, gained = adjusted(run, best, lead) or (None, "")
    wanted = [
        (f"{IN_WORDS[lead]} under {best}", run.score(best, lead)),
        (f"adjusted for difficulty, {gained}", better),
        *(
            (what, run.score(best, half))
            for what, half in zip(
                ("with a danger", "without a danger"), entry(lead).halves, strict=False
            )
        ),
        (f"gain over {base}", run.score(best, GAINS[lead]) if base == BASELINE else None),
        (f"unsafe episodes under {best}", run.score(best, "unsafe_rate")),
        (f"latency of a decision under {best}", run.score(best, LATENCY)),
        ("ego's answers that could not be read", run.score(metrics.ALL, "failed_rate_ego")),
    ]
    return [{"what": what, **shown(score)} for what, score in wanted if score is not None]


def as_good_as(plain: Estimate, corrected: Estimate) -> str:
    """Say how many times as many layouts the plain figure needs, less than 1 where it is better."""
    return f"as good as {worth(plain, corrected):.1f} times as many layouts"


def adjusted(run: Run, condition: str, metric: str) -> tuple[Score, str] | None:
    """Return success corrected by the layouts' difficulty, and what that is as good as.

    None of fewer layouts than `SHOWN_FROM`, and where an interval of every look leads,
    which this one is not.
    """
    plain, better = run.score(condition, metric), run.score(condition, ADJUSTED[metric])
    if not plain or not better or plain.interval == ANY_TIME or plain.n < SHOWN_FROM:
        return None
    return better, as_good_as(plain.estimate, better.estimate)


def adjusted_lines(run: Run) -> Iterator[str]:
    """Yield it of all conditions in which there is one, plain and balanced, as lines."""
    for metric, words in IN_WORDS.items():
        each = {name: figure for name in run.conditions if (figure := adjusted(run, name, metric))}
        cells = (
            f"{printable(name)} {written(score)}, {gained}"
            for name, (score, gained) in each.items()
        )
        if each:
            yield f"{words} % adjusted for difficulty: {'; '.join(cells)}"


def p_values(run: Run | SuiteRun, base: str) -> dict[str, float]:
    """Return p of each other condition's gain over `base`, in what leads;
    of a suite the mean gain's.
    """
    played = plays(_runs(run), lead_of(run))
    found = {c: p_of_mean(played.pairs(c, base)) for c in run.conditions if c != base}
    return {condition: 1.0 if p is None else p for condition, p in found.items()}


def p_value(p: float) -> str:
    """Return what stands behind `p`: `= 0.012`, or `< 0.001`, since no p-value is 0."""
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _runs(run: Run | SuiteRun) -> list[Run]:
    return [*run.runs.values()] if isinstance(run, SuiteRun) else [run]


def _shown(run: Run | SuiteRun, condition: str, metric: str) -> str:
    score = run.score(condition, metric)
    return shown(score)["value"] if score else "–"


def facts(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Return a nested mapping as lines of a table: dotted name and value."""
    if isinstance(value, Mapping):
        return [
            line
            for key, inner in value.items()
            for line in facts(inner, f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, list | tuple) and any(isinstance(inner, Mapping) for inner in value):
        return facts({str(n): inner for n, inner in enumerate(value, 1)}, name)
    if isinstance(value, list):
        return [(name, ", ".join(map(str, value)))]
    return [(name, value)]
