"""`harness run export`: a run for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core import extras, work
from harness.core.errors import UserError, printable

File = Path | None


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")],
    as_csv: Annotated[
        bool,
        typer.Option(
            "--csv",
            help="Write decisions.csv and answers.csv, one row per decision and answer. A text that a "
            "spreadsheet would take for a formula gets an apostrophe before it.",
        ),
    ] = False,
    as_jsonl: Annotated[
        bool, typer.Option("--jsonl", help="Write decisions.jsonl, one object per decision.")
    ] = False,
    out: Annotated[
        File, typer.Option(help="Folder for the files of --csv and --jsonl. Default: the run's.")
    ] = None,
    junit: Annotated[
        File, typer.Option(help="Write a JUnit XML file: one test case per episode and condition.")
    ] = None,
    inspect: Annotated[
        File, typer.Option(help="Write an Inspect AI log, NAME.eval: one sample per answer.")
    ] = None,
    sft: Annotated[
        File,
        typer.Option(
            help="Write chats to fine-tune on as JSON Lines; their answers are those that the decision "
            "trees show to be right."
        ),
    ] = None,
    dataset: options.RunsDataset = None,
    report_seeds_too: Annotated[
        bool,
        typer.Option(
            "--report-seeds-too", help="With --sft: also allow layouts with report seeds (200000 and above)."
        ),
    ] = False,
) -> None:
    """Write a run's data for spreadsheets and other programs. Give exactly one format."""
    from harness.runs import export
    from harness.runs.folder import read

    files = {"--junit": junit, "--inspect": inspect, "--sft": sft}
    asked = {"--csv": as_csv, "--jsonl": as_jsonl, **files}
    [option, *surplus] = [name for name, given in asked.items() if given] or [""]
    if surplus or not option:
        raise UserError(f"{', '.join(asked)}: give exactly one of them")
    if report_seeds_too and not sft:
        raise UserError("--report-seeds-too only goes with --sft; give --sft, or leave it out")
    if dataset and option not in ("--inspect", "--sft"):
        raise UserError("--dataset only goes with --inspect and --sft; leave it out")
    if out and option in files:
        raise UserError(
            f"--out only goes with --csv and --jsonl; {option} names its own file, so leave --out out"
        )
    if junit and (reason := work.unanswered(run)):
        from harness.report.page import save

        save([export.junit_of_none(run, reason)], junit, "--junit")
        typer.echo(printable(junit, 1000))
        return
    source, folder = read(run), out or run
    target = files.get(option)
    try:
        if as_csv:
            decisions, answers = source.decisions, source.answers  # both are read before anything is written
            written = [
                export.decisions_csv(decisions, folder / "decisions.csv"),
                export.answers_csv(answers, source.actions, folder / "answers.csv"),
            ]
        elif as_jsonl:
            written = [export.decisions_jsonl(source.decisions, folder / "decisions.jsonl")]
        elif junit:
            written = [export.junit(source, junit)]
        elif sft:
            from harness.training import pairs

            with bar("writing chats"):
                written = [pairs.write(source, sft, report_seeds_too, dataset)]
        elif inspect:
            extras.need("--inspect", "inspect_ai")
            from harness.report import inspect_log

            with bar("writing a log"):
                written = [inspect_log.write(source, inspect, dataset)]
    except OSError as error:
        where = f"{option} {printable(target)}" if target else f"{'--out ' if out else ''}{printable(folder)}"
        remedy = "name another file" if target else "choose another folder with --out"
        raise UserError(f"{where} cannot be written ({error.strerror}); {remedy}") from None
    for file in written:
        typer.echo(printable(file, 1000))
