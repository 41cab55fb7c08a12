"""`harness report`: one HTML page about a run."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path | None, typer.Option(help="File to write.", show_default="RUN/report.html")] = None,
) -> None:
    """Write a run's report: one HTML file that needs no network."""
    typer.echo(f"wrote {write(run, out)}")


def write(run: Path, out: Path | None, quiet: bool = False) -> Path:
    """Write a run's report, with a progress bar; returns the file."""
    from harness.cli.progress import bar
    from harness.report.page import DECISIONS, write_report

    with bar("drawing decisions", DECISIONS, quiet) as progress:
        return write_report(run, out, progress=progress)
