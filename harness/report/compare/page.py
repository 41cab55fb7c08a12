"""A comparison as one HTML file: needs no network and runs no script."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote, urlencode

import numpy as np
from markupsafe import Markup

from harness.core.errors import printable
from harness.core.statistics import Estimate
from harness.prompts.difference import marked
from harness.report.compare import words
from harness.report.compare.difference import Comparison, DecisionFlip, Difference, Flip
from harness.report.compare.gate import Verdict
from harness.report.compare.pair import Side
from harness.report.document import forest, reach
from harness.report.templating import environment
from harness.runs.folder import Run
from harness.runs.metrics import entry

TEMPLATES = Path(__file__).parent / "templates"
RAW = 300  # characters of an answer
Place = Callable[[Run], str | None]  # where the page of a run is, as a link


def render(comparison: Comparison, verdicts: Sequence[Verdict], most: int, place: Place) -> str:
    """Yield the page; `most` episodes and requests are listed of each kind,
    with links to the runs' pages.
    """
    pair = comparison.pair
    lost = {name: _lost(side) for name, side in (("A", pair.a), ("B", pair.b))}

    def links(condition: str, flip: Flip) -> Iterator[tuple[str, str]]:
        for name, side in (("A", pair.a), ("B", pair.b)):
            where, scene = place(side.run), lost[name].get((condition, flip.seeds[0], flip.episode))
            if where and scene:
                asked = {"scene": scene, "condition": condition, "seed": flip.seeds[0]}
                yield name, f"{where}#{urlencode(asked)}"

    def decided(condition: str, flip: DecisionFlip) -> Iterator[tuple[str, str, str | None]]:
        """Of each run: what its ego answered there alone, and where its page shows it."""
        for name, side in (("A", pair.a), ("B", pair.b)):
            asked = {"scene": flip.scene, "condition": condition, "seed": flip.seeds[0]}
            where, answers = place(side.run), side.run.answers_by_scene.get(flip.scene, ())
            raw = next((answer.raw for answer in answers if answer.role == "ego"), "nothing")
            yield name, printable(raw, RAW), where and f"{where}#{urlencode(asked)}"

    return (
        environment(TEMPLATES)
        .get_template("compare.html.j2")
        .render(
            comparison=comparison,
            pair=pair,
            verdicts=verdicts,
            most=most,
            words=words,
            links=links,
            decided=decided,
            marked=marked,
            forest=_forest(comparison),
        )
    )


def beside(out: Path) -> Place:
    """Return links from a file to the pages in the runs' folders, where there are any.

    A link names no folder of the machine:
    both lie below the current folder, or the page below the file.
    """
    here, at = Path.cwd(), out.resolve().parent

    def place(run: Run) -> str | None:
        page = run.path.resolve() / "report.html"
        near = page.is_relative_to(at) or all(path.is_relative_to(here) for path in (page, at))
        return quote(os.path.relpath(page, at)) if near and page.is_file() else None

    return place


def _lost(side: Side) -> dict[tuple[str, int, int], str]:
    """By condition, seed and episode the decision that lost it;
    where none is known to, the last.
    """
    run = side.run
    d = run.decisions
    condition, seed, episode = (
        d.codes("condition", run.conditions),
        d.whole("seed"),
        d.whole("episode"),
    )
    regret = np.nan_to_num(d["regret"]) == 1.0
    last: dict[tuple[str, int, int], str] = {}
    losing: dict[tuple[str, int, int], str] = {}
    for scene, rows in d.scenes.items():
        for n in range(rows.start, rows.stop):
            key = run.conditions[condition[n]], int(seed[n]), int(episode[n])
            last[key] = scene
            if regret[n]:
                losing.setdefault(key, scene)
    return last | losing


def _forest(comparison: Comparison) -> Callable[[Difference], Markup]:
    """Return what draws a difference:
    rates on one scale, any other metric on its own in all conditions.
    """

    def scale(metric: str) -> str:
        return "rate" if entry(metric).interval == "rate" else metric

    by_scale: dict[str, list[Estimate]] = {}
    for d in (d for c in comparison.conditions for d in c.differences):
        by_scale.setdefault(scale(d.metric), []).append(d.change)
    farthest = {name: max(map(abs, reach(changes))) or 1.0 for name, changes in by_scale.items()}

    def draw(d: Difference) -> Markup:
        most = farthest[scale(d.metric)]
        return forest(d.change, -most, most, words.verdict(d))

    return draw
