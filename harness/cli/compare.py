"""`harness compare`: two finished runs against each other."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import typer

from harness.cli import options
from harness.cli.next_command import after_comparison
from harness.cli.terminal import echo_json
from harness.core.errors import UserError, in_range, printable

if TYPE_CHECKING:
    from harness.report.compare.gate import Gate
    from harness.report.compare.logs import ComparedLogs

LISTED = 10  # episodes, decisions and requests of each kind that are listed


def command(
    a: Path = typer.Argument(
        help="Folder of the run to compare with, or a log of another program.", metavar="A"
    ),
    b: Path = typer.Argument(
        help="Folder of the run to judge, or a log like A: differences are B - A.", metavar="B"
    ),
    fail_if: list[str] | None = typer.Option(
        None,
        help="Gate on the difference B - A: '[CONDITION:]METRIC[.low|.high] OP NUMBER'. It fails "
        "where that "
        "is true: '6g:success_rate < -0.01' fails if 6g lost more than one point of success. Rates "
        "are from "
        "0 to 1; .low and .high are the ends of the 95 % interval; without CONDITION, the gate is "
        "on every "
        "condition, and A and B must have the same. Repeatable. Exit code 1 if a gate fails.",
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
    from harness.report.compare import logs, text
    from harness.report.compare.difference import compare as compared
    from harness.report.compare.gate import gate, judge, refuse_misstated
    from harness.report.compare.pair import pair
    from harness.report.page import refuse_less, refuse_other, save
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
            refuse_other(option, file)
    if html and junit and realpath(html) == realpath(junit):
        raise UserError(f"--html and --junit name one file, {printable(html)}; name two")
    if junit and not fail_if:
        raise UserError("--junit writes gates; give one or more with --fail-if")
    if reader := logs.reader_of(a, b):
        if html:
            raise UserError("--html shows runs, and A and B are logs; leave it out")
        comparison = reader.compare(a, b)
        _show_logs(comparison, fail_if or (), most, junit, as_markdown, as_json)
    gates = [gate(typed) for typed in fail_if or ()]
    reasons = {printable(run): why(run) for run in (a, b)} if gates else {}
    unasked = [f"{words} ({run})" for run, words in reasons.items() if words]
    with _in_junit(gates, junit):
        if unasked:
            raise UserError(
                f"{'; '.join(unasked)}: the model could not be asked, so that --fail-if has "
                "nothing to judge; type the command of the run again"
            )
        difference = compared(pair(a, b))
        if gates:
            refuse_misstated(difference.pair)
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
        if html:
            typer.echo(f"wrote {printable(html, 1000)}")
        after_comparison(difference, html)
    raise typer.Exit(1 if any(verdict.failed for verdict in verdicts) else 0)


def _show_logs(
    comparison: "ComparedLogs",
    fail_if: Sequence[str],
    show: int,
    junit: Path | None,
    as_markdown: bool,
    as_json: bool,
) -> NoReturn:
    """Print the comparison of two logs of another program, and end the command."""
    from harness.core.junit import junit as test_suite
    from harness.report.compare import logs, text
    from harness.report.compare.gate import gate, judge_changes
    from harness.report.page import save

    gates = [gate(typed, logs.METRICS, logs.PLACE, logs.EXAMPLE) for typed in fail_if]
    with _in_junit(gates, junit):
        if gates and comparison.unsure:
            raise UserError(
                f"{comparison.unsure}, so that --fail-if has nothing sure to judge; finish the "
                "logs, or leave --fail-if out"
            )
        verdicts = [judge_changes(each, comparison.changes, comparison.alone) for each in gates]
    if junit:
        cases = [text.case(comparison.title, verdict) for verdict in verdicts]
        save([test_suite("harness compare", cases)], junit, "--junit")
    if as_json:
        echo_json(comparison.mapping(verdicts, show))
    else:
        render = comparison.markdown if as_markdown else comparison.terminal
        typer.echo(render(verdicts, show))
    raise typer.Exit(1 if any(verdict.failed for verdict in verdicts) else 0)


@contextmanager
def _in_junit(gates: "Sequence[Gate]", junit: Path | None) -> Iterator[None]:
    """Enter a context in which gates are judged; what refuses that is in JUnit's XML, too."""
    from harness.report.compare.text import junit_of_none
    from harness.report.page import save

    try:
        yield
    except UserError as error:
        if junit:
            save([junit_of_none([each.text for each in gates], f"{error}")], junit, "--junit")
        raise
