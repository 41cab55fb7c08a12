"""`harness report`: one HTML page about a run, or about several side by side."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core.errors import UserError, printable
from harness.core.formats import SUITE

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.dataset.load import Dataset


def command(
    runs: options.Runs,
    out: Path | None = typer.Option(
        None, help="File to write. Default: RUN/report.html; needed for several runs."
    ),
    dataset: options.RunsDataset = None,
    full: options.FullPage = False,
    workers: options.PageWorkers = "2",
) -> None:
    """Write one HTML page about a run or suite, or about several. It works offline."""
    if out is None and len(runs) > 1:
        raise UserError(
            f"{len(runs)} runs and no --out; name the file to write, such as --out report.html"
        )
    page = write(runs, out, dataset=dataset, workers=options.workers_of(workers), full=full)
    typer.echo(f"wrote {printable(page)}")


def write(
    runs: list[Path],
    out: Path | None = None,
    quiet: bool = False,
    dataset: "Dataset | Path | None" = None,
    workers: "Workers" = 1,
    full: bool = False,
) -> Path:
    """Write the report of runs or suites with a progress bar, and return the file.

    Args:
        runs: folders of runs, or of suites.
        out: the file; None for report.html in the first folder.
        quiet: whether to show no progress.
        dataset: the runs' dataset, already loaded, or the folder it is in; None to find it.
        workers: worker processes.
        full: whether to include prompts of rules and all pictures.

    Raises UserError if they cannot be reported together.
    """
    if any((run / SUITE).is_file() for run in runs):
        if isinstance(dataset, Path):
            raise UserError(
                f"--dataset {printable(dataset)}: a suite has several; report its runs one by one"
            )
        if full:
            raise UserError("--full: a suite's page has no decisions; report its runs one by one")
        return _write_suites(runs, out, quiet)
    from harness.report.page import write_report
    from harness.report.runs import gather

    gathered = gather(runs, dataset)
    scenes = len({scene for run in gathered.runs for scene in run.decisions.scenes})
    with bar("packing decisions", scenes, quiet) as progress:
        page = out or runs[0] / "report.html"
        return write_report(gathered, page, progress=progress, workers=workers, full=full)


def _write_suites(folders: list[Path], out: Path | None, quiet: bool) -> Path:
    from harness.report import suite
    from harness.runs.suite import read

    if rest := [folder for folder in folders if not (folder / SUITE).is_file()]:
        raise UserError(f"{printable(rest[0])} is no suite, but others are; write separate reports")
    with bar("reading datasets", quiet=quiet):
        suites = [(each, suite.lines(each)) for each in map(read, dict.fromkeys(folders))]
    return suite.write(suites, out or folders[0] / "report.html")
