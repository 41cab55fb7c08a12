"""`harness report`: one HTML page about a run, or about several side by side."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    runs: Annotated[
        list[Path], typer.Argument(help="Folders of finished runs on the same scenes.", metavar="RUN...")
    ],
    out: Annotated[
        Path | None, typer.Option(help="File to write. Default: RUN/report.html; needed for several runs.")
    ] = None,
) -> None:
    """Write a report: one HTML file that needs no network. Several runs stand side by side in it."""
    from harness.core.errors import UserError

    if out is None and len(runs) > 1:
        raise UserError(f"{len(runs)} runs and no --out; name the file to write, such as --out report.html")
    typer.echo(f"wrote {write(runs, out)}")


def write(runs: list[Path], out: Path | None = None, quiet: bool = False) -> Path:
    """Write a report, with a progress bar; returns the file."""
    from harness.cli.progress import bar
    from harness.report.page import write_report
    from harness.report.runs import gather

    found = gather(runs)
    scenes = len({scene for run in found.runs for scene in run.decisions.scenes})
    with bar("packing decisions", scenes, quiet) as progress:
        return write_report(found, out or runs[0] / "report.html", progress=progress)
