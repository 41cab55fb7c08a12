"""`harness export`: a run's decisions and answers as text."""

from pathlib import Path
from typing import Annotated

import typer

from harness.core.errors import UserError, printable


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")],
    as_csv: Annotated[bool, typer.Option("--csv", help="Write decisions.csv and answers.csv.")] = False,
    as_jsonl: Annotated[
        bool, typer.Option("--jsonl", help="Write decisions.jsonl, an object a decision.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder to write to. Default: the run's.")] = None,
) -> None:
    """Write a run's decisions and answers as text. Spreadsheets and other programs read it."""
    from harness.runs.export import answers_csv, decisions_csv, decisions_jsonl
    from harness.runs.folder import read

    if as_csv == as_jsonl:
        raise UserError("--csv or --jsonl: give one of them")
    source = read(run)
    folder = out or run
    try:
        if as_csv:
            decisions, answers = source.decisions, source.answers  # both are read before anything is written
            written = [
                decisions_csv(decisions, folder / "decisions.csv"),
                answers_csv(answers, source.actions, folder / "answers.csv"),
            ]
        else:
            written = [decisions_jsonl(source.decisions, folder / "decisions.jsonl")]
    except OSError as error:
        raise UserError(
            f"{'--out ' if out else ''}{printable(folder)} cannot be written ({error.strerror}); "
            "choose another folder with --out"
        ) from None
    for file in written:
        typer.echo(printable(file, 1000))
