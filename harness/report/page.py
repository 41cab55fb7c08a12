"""One HTML file about one run: needs no network and runs no script.

Whatever a model, a prompt or a file name says is text: templates escape everything, characters that show
nothing or turn the line around are spelt out, and the page's own policy forbids scripts and requests.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, Undefined
from markupsafe import Markup

from harness.drawing.pictures import uri
from harness.drive.folder import LIVE, Driven, driven
from harness.errors import UserError, printable
from harness.files import write_whole
from harness.report import figures, words
from harness.report.choose import failures, pick
from harness.report.decisions import Prompts, cards, prompts_of
from harness.run.folder import FROZEN, Row, Run, read

DECISIONS = 60
TEMPLATES = Path(__file__).parent / "templates"


def write_report(
    run: Path,
    out: Path | None = None,
    prompts: Prompts | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write a run's report.

    Args:
        run: the run's folder.
        out: file to replace; None for `report.html` in the run's folder.
        prompts: gives the chat messages that a viewer was sent in a scene, with what it had heard; None
            renders the run's own prompt version, where it is here and unchanged.
        progress: called with the number of decisions just drawn, `DECISIONS` at most in all.

    Returns:
        The file written.

    Raises:
        UserError: the folder is no run, its dataset is gone or has changed, or `out` is a folder.
    """
    out = run / "report.html" if out is None else out
    if out.is_dir():
        raise UserError(f"--out {printable(out)} is a folder; name a file in it")
    found = read(run, FROZEN, LIVE)
    if found.config["format"] == LIVE.format:
        found = driven(found)
    write_whole(out, render(found, prompts or prompts_of(found), progress))
    return out


def render(run: Run, prompts: Prompts | None, progress: Callable[[int], None]) -> str:
    """The page."""
    picks = pick(run.rows, failures(run), DECISIONS)
    decisions = []
    for card in cards(run, picks, prompts):
        decisions.append(card)
        progress(1)
    chart = figures.success_latency(run)
    by_verdict = _count(run.rows, "verdict")
    return environment().get_template("page.html.j2").render(
        run=run,
        config=run.config,
        live=isinstance(run, Driven),
        title=run.config.get("name") or run.path.name,
        headline=words.headline(run),
        latency=words.latency_source(run.config["latency"]),
        points=_table(run.config["conditions"]),
        metrics=_metrics(run, run.conditions),
        answers=_metrics(run, ["all"]),
        chart=chart and uri(chart),
        statuses=_count(run.rows, "status"),
        verdicts=uri(figures.verdicts(by_verdict)),
        decisions=decisions,
    )  # fmt: skip


def environment(*more: Path) -> Environment:
    """The report's templates, and those of other folders: everything is escaped and made `visible`."""
    found = Environment(
        loader=FileSystemLoader([*more, TEMPLATES]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=visible,
    )
    found.filters |= {"number": words.number, "facts": words.facts}
    return found


def visible(value: Any) -> Any:
    """Text with every character that shows nothing, or turns the line around, spelt out. None is a dash."""
    if value is None or isinstance(value, Undefined):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "".join(c if c.isprintable() or c in "\n\t" else f"⟨U+{ord(c):04X}⟩" for c in value)


def _table(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Head and body of a table with a column for every key."""
    head = list(dict.fromkeys(key for row in rows for key in row))
    return head, [[row.get(key) for key in head] for row in rows]


def _metrics(run: Run, conditions: Sequence[str]) -> list[dict[str, Any]]:
    """The summary: a metric a line, with its value in each condition."""
    meanings = words.LIVE_MEANINGS if isinstance(run, Driven) else words.MEANINGS
    known = {s.metric: None for s in run.scores if s.condition in conditions}
    return [
        {
            "name": words.metric_name(metric),
            "meaning": meanings.get(metric, ""),
            "cells": [(s := run.score(condition, metric)) and words.shown(s) for condition in conditions],
        }
        for metric in known
    ]


def _count(rows: Iterable[Row], key: str) -> dict[str, Counter[str]]:
    """How many answers have which `status` or `verdict`, by role."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        for answer in (*row["answers"].values(), *row.get("merged", {}).values()):
            counts.setdefault(answer["role"], Counter())[answer[key]] += 1
    return counts
