"""`harness run export`: a run's data for other programs; extensions add formats."""

import inspect
from collections.abc import Container, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import typer

from harness.cli import options
from harness.cli.options import as_command
from harness.cli.progress import bar
from harness.core import extras, work
from harness.core.errors import UserError, printable
from harness.core.strangers import worded
from harness.runs.exports import EXPORTS, ROWS, Export, Option, options_of

# Words of the command's own options.
TAKEN = {
    "added",
    "as_csv",
    "as_jsonl",
    "csv",
    "dataset",
    "help",
    "jsonl",
    "junit",
    "out",
    "run",
    "schema",
    "values",
}
# of formats and their options, where no extension adds one
NONE: Mapping[str, Any] = MappingProxyType({})


def _formats() -> dict[str, Export]:
    """Return the formats that extensions add, by option,
    but those whose name is taken or no option's.
    """
    return {f"--{name}": format for name, format in EXPORTS.usable().items() if _is_free(name, ())}


def _options(formats: Mapping[str, Export]) -> dict[str, Option]:
    """Return the further options of formats by option; of two with one name the first."""
    options: dict[str, Option] = {}
    for format in formats.values():
        for name, option in options_of(format).items():
            if _is_free(name, formats):
                options.setdefault(f"--{name}", option)
    return options


def _is_free(name: str, formats: Container[str]) -> bool:
    return _word(name).isidentifier() and _word(name) not in TAKEN and f"--{name}" not in formats


def _word(flag: str) -> str:
    return flag.removeprefix("--").replace("-", "_")


def _with_formats(command: Any) -> Any:
    """Give a command the options that extensions add.

    It gets what is typed for a format's file as `added`,
    and for a further option as `values`, by option.
    """
    formats = _formats()
    options = _options(formats)

    def typed(**given: Any) -> Any:
        added = {flag: given.pop(_word(flag)) for flag in formats}
        values = {flag: given.pop(_word(flag)) for flag in options}
        return command(**given, added=added, values=values)

    instead = {
        "added": [_file(flag, format) for flag, format in formats.items()],
        "values": [_value(flag, option) for flag, option in options.items()],
    }
    parameters = []
    for each in inspect.signature(command).parameters.values():
        parameters += instead.get(each.name, [each.replace(kind=inspect.Parameter.KEYWORD_ONLY)])
    return as_command(typed, command, parameters)


def _file(flag: str, format: Export) -> inspect.Parameter:
    return _parameter(flag, typer.Option(None, help=format.help), Path | None)


def _value(flag: str, option: Option) -> inspect.Parameter:
    if option.kind is bool:
        return _parameter(flag, typer.Option(False, flag, help=option.help), bool)
    return _parameter(
        flag, typer.Option(None, help=option.help, show_default=False), option.kind | None
    )


def _parameter(flag: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(
        _word(flag), inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


@_with_formats
def command(
    run: Path = typer.Argument(help="Folder of a finished run.", metavar="RUN"),
    as_csv: bool = typer.Option(
        False,
        "--csv",
        help="Write decisions.csv and answers.csv, one row per decision and answer, and NAME.csv "
        "of what extensions keep with the run, such as notes. A text that a spreadsheet would "
        "take for a formula gets an apostrophe before it.",
    ),
    as_jsonl: bool = typer.Option(
        False, "--jsonl", help="Write decisions.jsonl, one object per decision."
    ),
    out: Path | None = typer.Option(
        None, help="Folder for the files of --csv and --jsonl. Default: the run's."
    ),
    junit: Path | None = typer.Option(
        None, help="Write a JUnit XML file: one test case per episode and condition."
    ),
    schema: Path | None = typer.Option(
        None,
        help="Write JSON Schemas of run.json, of a line of answers.jsonl and of a message on the "
        "air to this folder.",
    ),
    added: Mapping[str, Path | None] = NONE,
    values: Mapping[str, Any] = NONE,
    dataset: options.RunsDataset = None,
) -> None:
    """Write a run's data for spreadsheets and other programs. Give exactly one format."""
    from harness.core.formats import refuse_data
    from harness.runs import export
    from harness.runs.contradictions import refuse
    from harness.runs.folder import read

    files = {"--junit": junit, "--schema": schema, **added}
    formats_by_option = {"--csv": as_csv, "--jsonl": as_jsonl, **files}
    [option, *surplus] = [name for name, given in formats_by_option.items() if given] or [""]
    if surplus or not option:
        raise UserError(f"{', '.join(formats_by_option)}: give exactly one of them")
    formats = _formats()
    further = _options(formats)
    typed = {
        flag: value for flag, value in values.items() if value is not None and value is not False
    }
    for flag, value in typed.items():
        if why := further[flag].refusal(value, option):
            raise UserError(why)
    if dataset and option not in added:
        *most, last = added or ("formats that extensions add",)
        goes_with = f"{', '.join(most)} and {last}" if most else last
        raise UserError(f"--dataset only goes with {goes_with}; leave it out")
    if out and option in files:
        raise UserError(
            f"--out only goes with --csv and --jsonl; {option} names its own file, so leave --out "
            "out"
        )
    if junit and (reason := work.unanswered(run)):
        from harness.report.page import save

        save([export.junit_of_none(run, reason)], junit, "--junit")
        typer.echo(printable(junit, 1000))
        return
    source, folder = read(run), out or run
    if junit:
        from harness.report.page import refuse_other

        refuse_other("--junit", junit)
        refuse(source)
    target = files.get(option)
    if target:
        refuse_data(option, target)
    try:
        if as_csv:
            # all are read before anything is written
            decisions, answers = source.decisions, source.answers
            more = {name: table.of(source) for name, table in ROWS.usable().items()}
            written = [
                export.decisions_csv(decisions, folder / "decisions.csv"),
                export.answers_csv(answers, source.actions, folder / "answers.csv"),
            ]
            for name, rows in more.items():
                if rows:
                    columns, place = ROWS[name].columns, folder / f"{name}.csv"
                    written.append(export.rows_csv(columns, rows, place))
        elif as_jsonl:
            written = [export.decisions_jsonl(source.decisions, folder / "decisions.jsonl")]
        elif schema:
            written = export.schemas_json(source.actions, schema)
        elif junit:
            written = [export.junit(source, junit)]
        elif file := added.get(option):
            format = formats[option]
            extras.need(option, *(module for module in extras.OPTIONAL if module in format.needs))
            own_options = {f"--{name}": each for name, each in options_of(format).items()}
            rest = {
                _word(flag): value
                for flag, value in typed.items()
                if own_options.get(flag) is further[flag]
            }
            built_in = EXPORTS.is_ours(option.removeprefix("--"))
            with bar(format.doing), worded(f"format {option}", built_in):
                wrote: object = format.write(source, file, dataset, **rest)
                if not (isinstance(wrote, Path) and wrote.exists()):
                    raise ValueError("it wrote no file")
            written = [wrote]
    except OSError as error:
        where = (
            f"{option} {printable(target)}"
            if target
            else f"{'--out ' if out else ''}{printable(folder)}"
        )
        remedy = "name another file" if target else "choose another folder with --out"
        raise UserError(f"{where} cannot be written ({error.strerror}); {remedy}") from None
    for file in written:
        typer.echo(printable(file, 1000))
