"""A folder of pages to publish: the list of finished runs, and the page of each. Nothing serves it."""

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from urllib.parse import quote

from harness.core.errors import UserError, printable
from harness.core.files import making, write_whole
from harness.report import caveats, words
from harness.report import suite as suites
from harness.report.document import Section, Table, document, linked
from harness.report.page import render
from harness.report.runs import gather
from harness.report.view.folder import whole
from harness.report.view.pages import RUNS, suite_of, with_way_back
from harness.runs.folder import Run
from harness.runs.leading import IN_WORDS, lead_of
from harness.runs.listing import Listed, runs
from harness.runs.metrics import BASELINE, GAINS
from harness.runs.suite import SuiteRun

INDEX, PAGE = "index.html", "report.html"
HEADS = (
    "run", "success", f"gain over {BASELINE}", "unsafe", "n", "condition", "model", "prompt", "scenes",
    "kind", "began",
)  # fmt: skip
NOTE = (
    "Success, with its 95 % interval over episodes, is that of the run's best condition that no warning of "
    "its page is about. The gain is paired by episode. Unsafe episodes end in a collision or off the road, "
    "under the same condition. n is the number of episodes. The best of several conditions looks better "
    "than it is, and runs of other episodes are not to be compared by this table."
)


def export(folder: Path, out: Path, progress: Callable[[int], object]) -> list[str]:
    """Write the pages of a folder's finished runs and suites to a new folder, to be published as it is.

    Every page is drawn anew: what else lies in a run's folder is not published, nor are studies.

    Args:
        folder: what `harness view` lists.
        out: the folder, which exists only once it is complete.
        progress: counts runs.

    Returns:
        What was left out, each with the reason.

    Raises:
        UserError: `out` is there already or cannot be written, or no run can be shown.
    """
    if os.path.lexists(out):
        raise UserError(f"--export {printable(out)} is there already; give a new folder")
    listed = runs(folder)
    rows, warnings, left = [], [], []
    try:
        with making(out) as part:
            for run in listed:
                try:
                    page, done = _page(folder, run)
                except UserError as error:
                    left.append(f"{printable(run.name)}: {error}")
                else:
                    at = part / run.name / PAGE
                    home = quote(os.path.relpath(part / INDEX, at.parent))
                    write_whole(at, with_way_back(page, home=home))
                    rows.append(_row(run, done))
                    warnings += [f"{run.name}: {text}" for text in caveats.merged(_parts(done), caveats.void)]
                progress(1)
            if not rows:
                why = f" ({left[0]})" if left else ""
                raise UserError(
                    f"{printable(folder)} has no run that can be shown{why}; make one with `harness eval`"
                )
            table = Table("Finished runs, the newest first", HEADS, rows, NOTE, left=True)
            write_whole(part / INDEX, document([Section("Runs", tables=[table], warnings=warnings)]))
    except OSError as error:
        raise UserError(
            f"--export {printable(out)} cannot be written ({error.strerror}); give another folder"
        ) from None
    return left


def _page(folder: Path, run: Listed) -> tuple[str, Run | SuiteRun]:
    if run.state != "finished":
        raise UserError(f"{run.state} ({printable(run.why)})")
    if run.kind not in (*RUNS, "suite"):
        raise UserError(f"a {run.kind}; its folder can be published as it is")
    if not run.name.isprintable():
        raise UserError("its name cannot be sent; rename it")
    if run.kind == "suite":
        done = suite_of(folder, run.name)
        return suites.render([(done, suites.lines(done))], partial(_near, done.path)), done
    gathered = gather([whole(folder, run.name)])
    return render(gathered), gathered.runs[0]


def _near(path: Path, run: Run) -> str:
    return quote(os.path.relpath(run.path / PAGE, path))


def _parts(done: Run | SuiteRun) -> Mapping[str, Run]:
    return done.runs if isinstance(done, SuiteRun) else {"": done}


def _row(run: Listed, done: Run | SuiteRun) -> tuple[str, ...]:
    best, _ = words.compared(done)
    lead = lead_of(done)
    n = sum(len(part.grid.episodes) for part in _parts(done).values())
    figures = (words.cell(done.score(best, metric)) for metric in (lead, GAINS[lead], "unsafe_rate"))
    agents = run.model or "–", run.prompt or "–", done.source, run.kind
    where = linked(run.name, quote(f"{run.name}/{PAGE}"))
    return where, *figures, str(n), f"{best}, {IN_WORDS[lead]}", *agents, f"{run.date:%Y-%m-%d}"
