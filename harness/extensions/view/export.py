"""A folder of pages to publish: lists of finished runs and of studies, and the page of each."""

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from urllib.parse import quote

from harness.core.errors import UserError, printable
from harness.core.files import making, refuse_taken, write_whole
from harness.extensions.view.folder import own_file, whole
from harness.extensions.view.pages import RUNS, suite_of, whole_text, with_way_back
from harness.report import suite as suites
from harness.report import words
from harness.report.document import Chart, Section, Table, document, linked
from harness.report.findings import Kind, findings
from harness.report.page import render
from harness.report.runs import gather
from harness.runs.folder import Run
from harness.runs.headline import IN_WORDS, headline_of
from harness.runs.listing import Listed, runs
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.suite import SuiteRun

INDEX, PAGE = "index.html", "report.html"
HEADS = (
    "run",
    "success",
    f"gain over {BASELINE}",
    "unsafe",
    "n",
    "condition",
    "model",
    "prompt",
    "scenes",
    "kind",
    "began",
)
OF_STUDIES = ("study", "kind", "of", "written")
NOTE = (
    "Success, with its 95 % interval over episodes, is that of the run's best condition that no "
    "warning of its page is about. The gain is paired by episode. Unsafe episodes end in a "
    "collision or off the road, under the same condition. n is the number of episodes. The best of "
    "several conditions looks better than it is, and runs of other episodes are not to be compared "
    "by this table."
)


def export(folder: Path, out: Path, progress: Callable[[int], object]) -> list[str]:
    """Write the pages of a folder's finished runs, suites and studies to a new folder, to publish.

    A suite is one model's runs on several scenarios. Every page of a run is drawn anew: what else
    lies in its folder is not published. A study's page is published as it is, if it begins as one
    that may run no script but those which draw its charts.

    Args:
        folder: the folder whose runs `harness view` lists.
        out: the folder to make; it exists only once it is complete.
        progress: called with 1 for each run.

    Returns:
        A line for each run that was left out, with the reason.

    Raises:
        UserError: `out` is there already or cannot be written, or no run can be shown.
    """
    refuse_taken("--export", out)
    listed = runs(folder)
    rows, studies, warnings, left = [], [], [], []
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
                    if done is None:
                        link = linked(run.name, quote(f"{run.name}/{PAGE}"))
                        studies.append((link, run.kind, run.model or "–", f"{run.date:%Y-%m-%d}"))
                        continue
                    rows.append(_row(run, done))
                    void = findings(done, Kind.VOID)
                    warnings += [f"{run.name}: {finding.sentence}" for finding in void]
                finally:
                    progress(1)
            if not (rows or studies):
                why = f" ({left[0]})" if left else ""
                raise UserError(
                    f"{printable(folder)} has no run that can be shown{why}; make one with "
                    "`harness eval`"
                )
            of_runs = Table("Finished runs, the newest first", HEADS, rows, NOTE, left=True)
            of_studies = Table("Studies, the newest first", OF_STUDIES, studies, left=True)
            tables = [table for table in (of_runs, of_studies) if table.rows]
            write_whole(part / INDEX, document([Section("Runs", tables=tables, warnings=warnings)]))
    except OSError as error:
        raise UserError(
            f"--export {printable(out)} cannot be written ({error.strerror}); give another folder"
        ) from None
    return left


def _page(folder: Path, run: Listed) -> tuple[str, Run | SuiteRun | None]:
    """Return a page, and the run or suite that it is of; None for a study."""
    if run.state != "finished":
        raise UserError(f"{run.state} ({printable(run.why)})")
    if not run.name.isprintable():
        raise UserError("its name cannot be sent; rename it")
    if not {INDEX, PAGE}.isdisjoint(Path(run.name).parts):
        raise UserError("a page would have its name; rename it")
    if run.kind not in (*RUNS, "suite"):
        return _study(folder, run), None
    if run.kind == "suite":
        done = suite_of(folder, run.name)
        return suites.render([(done, suites.lines(done))], partial(_near, done.path)), done
    gathered = gather([whole(folder, run.name)])
    return render(gathered), gathered.runs[0]


def _study(folder: Path, run: Listed) -> str:
    file = own_file(folder, run.name, INDEX)
    page = whole_text(file) if file else ""
    # What stands there forbids scripts in all that follows, or all but those of charts, and only a
    # `http-equiv` could lead elsewhere.
    for charts in ({}, {"": Chart("", {})}):
        head = document([Section("", charts=charts)]).partition("<title>")[0]
        if page.startswith(head) and "http-equiv" not in page.removeprefix(head).casefold():
            return page
    raise UserError(f"a {run.kind} without a page that this version wrote; make it again")


def _near(path: Path, run: Run) -> str:
    return quote(os.path.relpath(run.path / PAGE, path))


def _parts(done: Run | SuiteRun) -> Mapping[str, Run]:
    return done.runs if isinstance(done, SuiteRun) else {"": done}


def _row(run: Listed, done: Run | SuiteRun) -> tuple[str, ...]:
    best, _ = words.compared(done)
    headline = headline_of(done)
    n = sum(len(part.grid.episodes) for part in _parts(done).values())
    figures = (
        words.cell(done.score(best, metric))
        for metric in (headline, GAINS[headline], "unsafe_rate")
    )
    agents = run.model or "–", run.prompt or "–", done.source, run.kind
    where = linked(run.name, quote(f"{run.name}/{PAGE}"))
    return where, *figures, str(n), f"{best}, {IN_WORDS[headline]}", *agents, f"{run.date:%Y-%m-%d}"
