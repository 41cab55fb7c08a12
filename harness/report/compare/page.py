"""A comparison as one HTML file: needs no network and runs no script."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from harness.report.findings import Kind
from harness.report.templating import environment
from harness.runs.folder import Run
from harness.runs.metrics import entry

TEMPLATES = Path(__file__).parent / "templates"
RAW = 300  # characters of an answer
Place = Callable[[Run], str | None]  # where the page of a run is, as a link


def render(comparison: Comparison, verdicts: Sequence[Verdict], most: int, place: Place) -> str:
    """Return the HTML page of a comparison with its gates' verdicts.

    A gate is a test that the comparison may fail. `most` is how many episodes and requests a list
    shows; `place` takes a run and returns the link to its page, or None.
    """
    pair = comparison.pair
    sides = {"A": pair.a, "B": pair.b}
    lost = {name: _lost(side) for name, side in sides.items()}

    def link(side: Side, scene: str, condition: str, seed: int) -> str | None:
        page = place(side.run)
        decision = {"scene": scene, "condition": condition, "seed": seed}
        return page and f"{page}#{urlencode(decision)}"

    def links(condition: str, flip: Flip) -> Iterator[tuple[str, str]]:
        """Yield the name of each run, and where its page shows the decision that lost."""
        seed = flip.seeds[0]
        for name, side in sides.items():
            scene = lost[name].get((condition, seed, flip.episode))
            address = link(side, scene, condition, seed) if scene else None
            if address:
                yield name, address

    def decided(condition: str, flip: DecisionFlip) -> Iterator[tuple[str, str, str, str | None]]:
        """Yield of each run what its ego answered there alone, what it took if that is another
        action, and where its page shows it.
        """
        for (name, side), action in zip(sides.items(), (flip.a, flip.b), strict=True):
            answers = side.run.answers_by_scene.get(flip.scene, ())
            ego = next((answer for answer in answers if answer.role == "ego"), None)
            place, turned = ego.likeliest if ego else None, ""
            if place is not None and side.run.actions[place] != action:
                turned = f"; with what it heard, it took {action}"
            raw = printable(ego.raw if ego else "nothing", RAW)
            yield name, raw, turned, link(side, flip.scene, condition, flip.seeds[0])

    template = environment(TEMPLATES).get_template("compare.html.j2")
    return template.render(
        comparison=comparison,
        pair=pair,
        verdicts=verdicts,
        most=most,
        words=words,
        links=links,
        decided=decided,
        marked=marked,
        above=words.caveats(pair, (Kind.VOID, Kind.CAVEAT)),
        below=words.caveats(pair, (Kind.LIMIT,)),
        changes=_drawn(words.of_success(comparison)),
        first_lost=words.first_lost(comparison),
        forest=_forest(comparison),
    )


def beside(out: Path) -> Place:
    """Return a function that gives the link from the file `out` to a run's report.html, or None.

    It links only where the relative path names no folder outside: both files are below the current
    folder, or the report is below that of `out`.
    """
    here, folder = Path.cwd(), out.resolve().parent

    def place(run: Run) -> str | None:
        page = run.path.resolve() / "report.html"
        both_here = page.is_relative_to(here) and folder.is_relative_to(here)
        if not page.is_file() or not (both_here or page.is_relative_to(folder)):
            return None
        return quote(os.path.relpath(page, folder))

    return place


def _lost(side: Side) -> dict[tuple[str, int, int], str]:
    """Return by condition, seed and episode the scene of the decision that lost it;
    where none is known to, of the last.
    """
    run, decisions = side.run, side.run.decisions
    condition = decisions.codes("condition", run.conditions)
    seed, episode = decisions.whole("seed"), decisions.whole("episode")
    regret = np.nan_to_num(decisions["regret"]) == 1.0
    last: dict[tuple[str, int, int], str] = {}
    losing: dict[tuple[str, int, int], str] = {}
    for scene, rows in decisions.scenes.items():
        for n in range(rows.start, rows.stop):
            key = run.conditions[condition[n]], int(seed[n]), int(episode[n])
            last[key] = scene
            if regret[n]:
                losing.setdefault(key, scene)
    return last | losing


def _drawn(changes: Mapping[str, Difference]) -> dict[str, Markup]:
    """Draw differences on one scale, with 0 in the middle; by the same names."""
    low, high = reach(d.change for d in changes.values())
    most = max(abs(low), abs(high)) or 1.0
    return {name: forest(d.change, -most, most, words.verdict(d)) for name, d in changes.items()}


def _forest(comparison: Comparison) -> Callable[[Difference], Markup]:
    """Return what draws a difference:
    rates on one scale, any other metric on its own in all conditions.
    """

    def scale(metric: str) -> str:
        return "rate" if entry(metric).interval == "rate" else metric

    by_scale: dict[str, list[Estimate]] = {}
    for condition in comparison.conditions:
        for d in condition.differences:
            by_scale.setdefault(scale(d.metric), []).append(d.change)
    farthest = {}
    for name, changes in by_scale.items():
        low, high = reach(changes)
        farthest[name] = max(abs(low), abs(high)) or 1.0

    def draw(d: Difference) -> Markup:
        most = farthest[scale(d.metric)]
        return forest(d.change, -most, most, words.verdict(d))

    return draw
