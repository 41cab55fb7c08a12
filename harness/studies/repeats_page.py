"""What a folder of repeats has beside its runs: what came out in sentences, all figures, and a page."""

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec

from harness.core.figures import Unit, shown
from harness.core.files import write_whole
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.report.caveats import caveats, said
from harness.report.compare.page import beside
from harness.report.page import environment
from harness.runs.folder import csv_text
from harness.runs.metrics import ALL, SUCCESS
from harness.runs.records import Score
from harness.studies.repeats import BETWEEN, DOUBT, FLIPS, SAMPLED, STABLE, STATED, Repeats

TEMPLATES = Path(__file__).parent / "templates"
MARKER, FIGURES, PAGE = "repeats.json", "repeats.csv", "index.html"
MOST_POINTS = 12  # of those at which repeats disagree


def nats(e: Estimate) -> str:
    """An entropy with its interval; a dash where it is not known."""
    return shown(e, Unit("nats", 2))


def in_sentences(of: Repeats) -> list[str]:
    """What came out, the most telling first; n and 95 % interval of each figure."""
    return [_flips(of), *_between(of), *_doubt(of)]


def _flips(of: Repeats) -> str:
    known = [c for c in of.conditions if not math.isnan(of.estimate(c, FLIPS).value)]
    m, k = of.runs[0].manifest, of.k
    c = max(known or of.conditions, key=lambda c: of.estimate(c, FLIPS).value)
    flips, once = of.estimate(c, FLIPS), of.estimate(c, SUCCESS)
    everywhere, anywhere = of.estimate(c, f"pass^{k}"), of.estimate(c, f"any@{k}")
    return (
        f"Asked again at temperature {m.temperature:g}, {m.variant} decides differently in {shown(flips)} % "
        f"of decisions under {c} (n = {flips.n} decision points). {shown(once)} % of its episodes succeed, "
        f"{shown(everywhere)} % in all {k} repeats and {shown(anywhere)} % in at least one "
        f"(n = {once.n} episodes)."
    )


def _between(of: Repeats) -> Iterator[str]:
    shares = {c: e for c in of.conditions if not math.isnan((e := of.estimate(c, BETWEEN)).value)}
    if shares:
        c = min(shares, key=lambda c: shares[c].value)
        yield (
            f"Under {c}, {shown(shares[c])} % of the variance of success lies between episodes "
            f"(n = {shares[c].n}); the rest is chance between repeats of one episode."
        )


def _doubt(of: Repeats) -> Iterator[str]:
    stated, sampled, more = (of.estimate(ALL, name) for name in (STATED, SAMPLED, DOUBT))
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


def write_repeats(of: Repeats) -> Path:
    """Write figures and the page, `repeats.json` last; returns the page's path."""
    first = of.runs[0].manifest
    write_whole(of.path / FIGURES, csv_text(Score, of.scores, first.variant))
    page = of.path / PAGE
    rendered = environment(TEMPLATES).get_template("repeats.html.j2").render(
        of=of, sentences=in_sentences(of), percent=shown, nats=nats, manifest=first,
        caveats=said({run.path.name: run for run in of.runs}, lambda run: caveats(run.manifest, run.scores)),
        wavering=of.wavering(MOST_POINTS), source=of.runs[0].source, conditions=of.conditions,
        metrics=(FLIPS, STABLE, SUCCESS, f"pass^{of.k}", f"any@{of.k}", BETWEEN), success=SUCCESS,
        entropies=(STATED, SAMPLED, DOUBT), all=ALL, place=beside(page),
    )  # fmt: skip
    write_whole(page, rendered)
    manifest = {
        "format": "swarmdrive-repeats/1",
        "sources": [{"name": first.variant.model}],
        "runs": [run.path.name for run in of.runs],
        "temperature": first.temperature,
        "sampling_seeds": [run.manifest.sampling_seed for run in of.runs],
        "dataset": of.runs[0].source,
        "conditions": list(of.conditions),
        "versions": versions(),
    }
    write_whole(of.path / MARKER, msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
    return page
