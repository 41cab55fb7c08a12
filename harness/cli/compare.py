"""`harness compare`: two finished runs against each other."""

import json
from pathlib import Path
from typing import Annotated

import typer

from harness.core.errors import UserError, printable


def compare(
    a: Annotated[Path, typer.Argument(help="Folder of the base run.", metavar="A")],
    b: Annotated[Path, typer.Argument(help="Folder of the run that is held against it.", metavar="B")],
    fail_if: Annotated[
        list[str] | None,
        typer.Option(
            help="Gate on B - A: '[CONDITION:]METRIC[.low|.high] OP NUMBER', in any condition unless one is "
            "named; shares from 0 to 1. Repeatable. Exit code 1 if one fails."
        ),
    ] = None,
    show: Annotated[int, typer.Option(help="Most episodes and requests to list of each kind.")] = 10,
    html: Annotated[Path | None, typer.Option(help="File to write a page to as well.")] = None,
    as_markdown: Annotated[
        bool, typer.Option("--markdown", help="Print Markdown, for a pull request.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """What changed from run A to run B, paired by episode and seed. Exit code 1 if a gate fails."""
    from harness.cli.estimates import in_range
    from harness.report.compare import text
    from harness.report.compare.difference import compare as compared
    from harness.report.compare.gate import gate, judge
    from harness.report.compare.pair import pair

    if as_markdown and as_json:
        raise UserError("--markdown and --json: give one of them")
    in_range("--show", show, 0, 100_000)
    if html and html.is_dir():
        raise UserError(f"--html {printable(html)} is a folder; name a file in it")
    gates = [gate(typed) for typed in fail_if or ()]
    found = compared(pair(a, b))
    verdicts = [judge(one, found) for one in gates]
    if html:
        from harness.report.compare.page import render
        from harness.report.page import save

        save(render(found, verdicts, show), html, "--html")
    if as_json:
        typer.echo(json.dumps(text.mapping(found, verdicts, show), indent=1, allow_nan=False))
    else:
        typer.echo((text.markdown if as_markdown else text.terminal)(found, verdicts, show))
    raise typer.Exit(1 if any(verdict.failed for verdict in verdicts) else 0)
