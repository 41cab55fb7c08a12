"""The study of repeats: how often decisions flip, how episodes succeed, and what entropy answers state."""

import math
from collections.abc import Iterator

import msgspec
from markupsafe import Markup

from harness.core.figures import Unit, shown
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.report.caveats import caveats, merged
from harness.report.compare.page import beside
from harness.report.document import Table
from harness.runs.metrics import ALL, SUCCESS
from harness.studies.repeats import BETWEEN, DOUBT, FLIPS, SAMPLED, STABLE, STATED, Repeats
from harness.studies.study import Study

MARKER, FIGURES, PAGE = "repeats.json", "repeats.csv", "index.html"
MOST_POINTS = 12  # of those at which repeats disagree
NATS = Unit("nats", 2)


def repeats_study(repeats: Repeats) -> Study:
    """Declare the study of repeats."""
    import pandas as pd

    first, source, k = repeats.runs[0].manifest, repeats.runs[0].source, repeats.k
    variant, place = msgspec.to_builtins(first.variant), beside(repeats.path / PAGE)
    rows = [{**variant, **msgspec.to_builtins(score)} for score in repeats.scores]
    reports = ((place(run), run.path.name) for run in repeats.runs)
    links = (Markup('<p><a href="{}">Report of {}</a></p>').format(*each) for each in reports if each[0])
    return Study(
        "repeats", f"{k} repeats of {first.variant} on {source}", headline(repeats),
        [
            f"{k} repeats × {len(first.seeds)} channel seeds of {len(repeats.runs[0].grid.episodes)} "
            f"episodes at temperature {first.temperature:g}. Each repeat is a whole run with its own "
            "sampling seed, and with the same episodes and channel seeds, so they differ only in the "
            "random draws of the model's answers. 95 % intervals are over episodes. All figures are in "
            "repeats.csv."
        ],
        list(_tables(repeats)), {"repeats": pd.DataFrame(rows)},
        {
            "sources": [{"name": first.variant.model}], "runs": [run.path.name for run in repeats.runs],
            "temperature": first.temperature,
            "sampling_seeds": [run.manifest.sampling_seed for run in repeats.runs],
            "dataset": source, "conditions": list(repeats.conditions), "versions": versions(),
        },
        {
            "repeats": str(repeats.path), "runs": [str(run.path) for run in repeats.runs],
            "temperature": first.temperature, "figures": rows,
        },
        caveats=merged(
            {run.path.name: run for run in repeats.runs}, lambda run: caveats(run.manifest, run.scores)
        ),
        more=Markup("\n").join(links),
    )  # fmt: skip


def _tables(repeats: Repeats) -> Iterator[Table]:
    k, episodes = repeats.k, len(repeats.runs[0].grid.episodes)

    def cells(condition: str, *metrics: str) -> list[str]:
        return [shown(repeats.estimate(condition, metric)) for metric in metrics]

    yield Table(
        "Decisions",
        ("condition", "decisions flip, %", "same in all, %", "n", "variance between %"),
        [
            (c, *cells(c, FLIPS, STABLE), str(repeats.estimate(c, FLIPS).n), *cells(c, BETWEEN))
            for c in repeats.conditions
        ],
        "A decision flips if two repeats that both reached a decision point chose different actions "
        "there. The first column is the share of such pairs; the second is the share of the n decision "
        "points at which all repeats that reached them chose the same action. Points that only one repeat "
        "reached count in neither. Variance between episodes is the intraclass correlation of success, "
        "ICC(1): 100 % if repeats change nothing, about 0 if knowing the episode does not help to predict "
        f"its repeats, a dash if all outcomes are the same; n is {episodes} episodes.",
        terminal=range(5),
    )
    passes, anys = ([f"{name}{j}" for j in range(2, k + 1)] for name in ("pass^", "any@"))
    heads = ("condition", "episodes succeed, %", *passes, *anys)
    yield Table(
        "Episodes", heads, [(c, *cells(c, SUCCESS, *passes, *anys)) for c in repeats.conditions],
        f"Of j repeats drawn from the {k} without replacement, pass^j: all succeed, and any@j: one or more "
        "succeeds; in "
        f"percent of n = {episodes} episodes.", terminal=(0, 1, k, len(heads) - 1),
    )  # fmt: skip
    yield Table(
        "Stated and sampled entropy", ("entropy of the ego's own answers", "nats", "decision points"),
        [
            (name.removesuffix("_nats").replace("_", " "), nats(e), str(e.n))
            for name in (STATED, SAMPLED, DOUBT) if (e := repeats.estimate(ALL, name))
        ],
        "Stated: the mean entropy of the distributions in the answers. Sampled: the entropy, over "
        f"repeats, of the most probable action, with the correction of Miller and Madow. From {k} repeats "
        "it is a rough estimate, and too small on average. Points with fewer than two answers that could "
        "be read are left out.",
    )  # fmt: skip
    if points := repeats.wavering(MOST_POINTS):
        yield Table(
            "Where most pairs of repeats disagree",
            ("decision point", "condition", "pairs that differ, %", "actions chosen"),
            [
                (
                    point.scene, point.condition, f"{100 * point.flips:.0f}",
                    ", ".join(f"{n} × {action}" for action, n in point.actions.items()),
                )
                for point in points
            ],
            f"Over all repeats and channel seeds. harness report {repeats.runs[0].path.name}, typed in this "
            "folder, shows the prompts and answers.",
        )  # fmt: skip


def nats(e: Estimate) -> str:
    """Return an entropy with its interval; a dash where it is not known."""
    return shown(e, NATS)


def headline(repeats: Repeats) -> list[str]:
    """Say how often decisions flip, how much of success is chance, and what the ego states of it."""
    return [_flips(repeats), *_between(repeats), *_doubt(repeats)]


def _flips(repeats: Repeats) -> str:
    known = [c for c in repeats.conditions if not math.isnan(repeats.estimate(c, FLIPS).value)]
    m, k = repeats.runs[0].manifest, repeats.k
    c = max(known or repeats.conditions, key=lambda c: repeats.estimate(c, FLIPS).value)
    flips, once = repeats.estimate(c, FLIPS), repeats.estimate(c, SUCCESS)
    everywhere, anywhere = repeats.estimate(c, f"pass^{k}"), repeats.estimate(c, f"any@{k}")
    return (
        f"Asked again at temperature {m.temperature:g}, {m.variant} decides differently in {shown(flips)} % "
        f"of decisions under {c} (n = {flips.n} decision points). {shown(once)} % of its episodes succeed, "
        f"{shown(everywhere)} % in all {k} repeats and {shown(anywhere)} % in at least one "
        f"(n = {once.n} episodes)."
    )


def _between(repeats: Repeats) -> Iterator[str]:
    shares = {c: e for c in repeats.conditions if not math.isnan((e := repeats.estimate(c, BETWEEN)).value)}
    if shares:
        c = min(shares, key=lambda c: shares[c].value)
        yield (
            f"Under {c}, {shown(shares[c])} % of the variance of success lies between episodes "
            f"(n = {shares[c].n}); the rest is chance between repeats of one episode."
        )


def _doubt(repeats: Repeats) -> Iterator[str]:
    stated, sampled, more = (repeats.estimate(ALL, name) for name in (STATED, SAMPLED, DOUBT))
    if math.isnan(more.value):
        return
    verdict = "not clearly more or less than its repeats show"
    if more.low > 0:
        verdict = "more than its repeats show"
    elif more.high < 0:
        verdict = "less than its repeats show"
    yield (
        f"The ego's answers state {nats(stated)} nats of entropy, {verdict}: over repeats, the most probable "
        f"action has {nats(sampled)} nats (difference {nats(more)}; n = {more.n} decision points)."
    )
