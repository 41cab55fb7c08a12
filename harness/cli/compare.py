"""`harness compare`: two finished runs against each other."""

from os.path import realpath
from pathlib import Path

import typer

from harness.cli import options
from harness.cli.next_command import after_comparison
from harness.cli.terminal import echo_json
from harness.core.errors import UserError, in_range, printable
from harness.core.formats import refuse_data

LISTED = 10  # episodes, decisions and requests of each kind that are listed


def command(
    a: Path = typer.Argument(help="Folder of the run to compare with.", metavar="A"),
    b: Path = typer.Argument(
        help="Folder of the run to judge: differences are B - A.", metavar="B"
    ),
    fail_if: list[str] | None = typer.Option(
        None,
        help="Gate on the difference B - A: '[CONDITION:]METRIC[.low|.high] OP NUMBER'. It fails "
        "where that "
        "is true: '6g:success_rate < -0.01' fails if 6g lost more than one point of success. Rates "
        "are from "
        "0 to 1; .low and .high are the ends of the 95 % interval; without CONDITION, the gate is "
        "on every "
        "condition. Repeatable. Exit code 1 if a gate fails.",
    ),
    show: int | None = typer.Option(
        None,
        help="Number of episodes, decisions and requests to list of each kind; implies --verbose. "
        f"Default: {LISTED}.",
    ),
    html: Path | None = typer.Option(
        None, help="Also write the comparison as a page to this file."
    ),
    junit: Path | None = typer.Option(
        None, help="Also write the gates to this file, as test cases in JUnit XML for a CI system."
    ),
    every: bool = typer.Option(
        False,
        "--all",
        help="Print every metric, not only the primary ones and what changed most clearly.",
    ),
    as_markdown: bool = typer.Option(
        False, "--markdown", help="Print Markdown, such as for a comment on a pull request."
    ),
    as_json: options.Json = False,
    verbose: options.Verbose = False,
) -> None:
    """Show what changed from run A to B, by episode and seed. Exit code 1 if a gate fails."""
    from harness.report.compare import text
    from harness.report.compare.difference import compare as compared
    from harness.report.compare.gate import gate, judge
    from harness.report.compare.pair import pair
    from harness.report.page import refuse_less, save
    from harness.runs.unanswered import why

    if as_markdown and as_json:
        raise UserError("--markdown and --json: give one of them")
    verbose = verbose or every or show is not None
    most = LISTED if show is None else show
    in_range("--show", most, 0, 100_000)
    for option, file in (("--html", html), ("--junit", junit)):
        if file and file.is_dir():
            raise UserError(f"{option} {printable(file)} is a folder; name a file in it")
        if file:
            refuse_data(option, file)
    if html and junit and realpath(html) == realpath(junit):
        raise UserError(f"--html and --junit name one file, {printable(html)}; name two")
    if junit and not fail_if:
        raise UserError("--junit writes gates; give one or more with --fail-if")
    gates = [gate(typed) for typed in fail_if or ()]
    if reasons := [
        f"{words} ({printable(run)})" for run in (a, b) if gates and (words := why(run))
    ]:
        lacks = (
            f"{'; '.join(reasons)}: the model could not be asked, so that --fail-if has nothing to "
            "judge"
        )
        if junit:
            save([text.junit_of_none([each.text for each in gates], lacks)], junit, "--junit")
        raise UserError(f"{lacks}; type the command of the run again")
    difference = compared(pair(a, b))
    verdicts = [judge(each, difference) for each in gates]
    if html:
        from harness.report.compare import page

        lacking = difference.prompts
        refuse_less(html, {"prompts": lacking} if isinstance(lacking, str) else {}, "--html")
        save([page.render(difference, verdicts, most, page.beside(html))], html, "--html")
    if junit:
        save([text.junit(difference, verdicts)], junit, "--junit")
    if as_json:
        echo_json(text.mapping(difference, verdicts, most))
    elif as_markdown:
        typer.echo(text.markdown(difference, verdicts, most, every))
    elif verbose:
        typer.echo(text.terminal(difference, verdicts, most, every))
    else:
        typer.echo(text.brief(difference, verdicts))
        after_comparison(difference)
    raise typer.Exit(1 if any(verdict.failed for verdict in verdicts) else 0)
