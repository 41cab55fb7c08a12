"""`harness run export`: a run's data for other programs; extensions add formats."""

import inspect
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core import extras, work
from harness.core.errors import UserError, printable
from harness.runs.exports import EXPORTS, Export

MARGIN = 0.1  # by how much an answer is worth less than the one that is preferred to it
# Words of the command's own options.
TAKEN = {
    "added", "as_csv", "as_jsonl", "csv", "dataset", "dpo", "help", "jsonl", "junit", "margin", "out",
    "report_seeds_too", "run", "sft",
}  # fmt: skip
NONE: Mapping[str, Path | None] = MappingProxyType({})  # of formats, where no extension adds one


def _formats() -> dict[str, Export]:
    """Return the formats that extensions add, by option, but those whose name is taken or no option's."""
    return {
        f"--{name}": format
        for name, format in EXPORTS.usable().items()
        if (word := name.replace("-", "_")).isidentifier() and word not in TAKEN
    }


def _with_formats(command: Any) -> Any:
    """Give a command the option of each format that extensions add; it gets what is typed as `added`."""
    formats = _formats()
    named = {flag: flag.removeprefix("--").replace("-", "_") for flag in formats}

    def typed(**values: Any) -> Any:
        added = {flag: values.pop(name) for flag, name in named.items()}
        return command(**values, added=added)

    parameters = []
    for each in inspect.signature(command).parameters.values():
        if each.name == "sft":
            parameters += [_option(named[flag], format) for flag, format in formats.items()]
        if each.name != "added":
            parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    typed.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    typed.__annotations__ = {each.name: each.annotation for each in parameters}
    typed.__doc__, typed.__name__ = command.__doc__, command.__name__
    return typed


def _option(name: str, format: Export) -> inspect.Parameter:
    default = typer.Option(None, help=format.help)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Path | None)


@_with_formats
def command(
    run: Path = typer.Argument(help="Folder of a finished run.", metavar="RUN"),
    as_csv: bool = typer.Option(
        False,
        "--csv",
        help="Write decisions.csv and answers.csv, one row per decision and answer. A text that a "
        "spreadsheet would take for a formula gets an apostrophe before it.",
    ),
    as_jsonl: bool = typer.Option(False, "--jsonl", help="Write decisions.jsonl, one object per decision."),
    out: Path | None = typer.Option(
        None, help="Folder for the files of --csv and --jsonl. Default: the run's."
    ),
    junit: Path | None = typer.Option(
        None, help="Write a JUnit XML file: one test case per episode and condition."
    ),
    sft: Path | None = typer.Option(
        None,
        help="Write chats to fine-tune on as JSON Lines; their answers are those that the decision trees "
        "show to be right.",
    ),
    dpo: Path | None = typer.Option(
        None,
        help="Write the same chats with the model's own answers as the rejected ones, where these are worse.",
    ),
    margin: float | None = typer.Option(
        None,
        help="With --dpo: how much less an answer must be worth, above 0 to 1. Default: 0.1.",
        show_default=False,
    ),
    dataset: options.RunsDataset = None,
    report_seeds_too: bool = typer.Option(
        False,
        "--report-seeds-too",
        help="With --sft and --dpo: also allow layouts with report seeds (200000 and above).",
    ),
    added: Mapping[str, Path | None] = NONE,
) -> None:
    """Write a run's data for spreadsheets and other programs. Give exactly one format."""
    from harness.runs import export
    from harness.runs.contradictions import refuse
    from harness.runs.folder import read

    files = {"--junit": junit, **added, "--sft": sft, "--dpo": dpo}
    asked = {"--csv": as_csv, "--jsonl": as_jsonl, **files}
    [option, *surplus] = [name for name, given in asked.items() if given] or [""]
    if surplus or not option:
        raise UserError(f"{', '.join(asked)}: give exactly one of them")
    if report_seeds_too and not (sft or dpo):
        raise UserError("--report-seeds-too only goes with --sft and --dpo; give one, or leave it out")
    if margin is not None and not (dpo and 0 < margin <= 1):
        raise UserError(f"--margin {margin:g}: it goes with --dpo, and is above 0 and at most 1")
    if dataset and option not in (*added, "--sft", "--dpo"):
        raise UserError(f"--dataset only goes with {', '.join((*added, '--sft'))} and --dpo; leave it out")
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
    if junit:
        refuse(source)
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
        elif lessons := sft or dpo:
            from harness.training import pairs

            least = (margin or MARGIN) if dpo else None
            with bar("writing chats"):
                written = [pairs.write(source, lessons, report_seeds_too, dataset, least)]
        elif file := added.get(option):
            format = _formats()[option]
            extras.need(option, *(module for module in extras.OPTIONAL if module in format.needs))
            with bar(format.doing):
                written = [format.write(source, file, dataset)]
    except OSError as error:
        where = f"{option} {printable(target)}" if target else f"{'--out ' if out else ''}{printable(folder)}"
        remedy = "name another file" if target else "choose another folder with --out"
        raise UserError(f"{where} cannot be written ({error.strerror}); {remedy}") from None
    for file in written:
        typer.echo(printable(file, 1000))
