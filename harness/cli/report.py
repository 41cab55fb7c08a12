"""`harness report`: one HTML page about a run."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path | None, typer.Option(help="File to write.", show_default="RUN/report.html")] = None,
) -> None:
    """Write a run's report: one HTML file that needs no network."""
    from harness.report.page import write_report

    typer.echo(f"wrote {write_report(run, out)}")
