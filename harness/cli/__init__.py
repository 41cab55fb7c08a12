"""The command line: parses, calls one function, prints where it wrote.

Heavy packages load inside the commands, so that `harness --help` answers at once.
"""

import sys
from typing import Any

import typer

from harness.cli import (
    campaign,
    compare,
    dataset,
    distill,
    doctor,
    drive,
    evaluate,
    export,
    fidelity,
    init,
    ls,
    model,
    parity,
    parse,
    prompt,
    report,
    scenario,
    sweep,
    video,
    view,
)
from harness.core.errors import UserError, printable

app = typer.Typer(
    name="harness",
    help="Evaluate prompts and parsing in cooperative driving.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("eval")(evaluate.evaluate)
app.command("drive")(drive.drive)
app.command("init")(init.init)
app.command("ls")(ls.ls)
app.command("view")(view.view)
app.command("video")(video.command)
app.add_typer(prompt.app, name="prompt")
app.add_typer(dataset.app, name="dataset")
app.add_typer(scenario.app, name="scenario")
app.add_typer(model.app, name="model")
app.command("report")(report.command)
app.command("parse")(parse.command)
app.command("distill")(distill.distill)
app.command("sweep")(sweep.sweep)
app.command("fidelity")(fidelity.fidelity)
app.command("compare")(compare.compare)
app.command("export")(export.export)
app.command("doctor")(doctor.doctor)
app.add_typer(campaign.app, name="campaign")
app.command("parity")(parity.parity)

# typer carries a click of its own and exports of its errors only this one's children.
_UsageError: Any = typer.BadParameter.__mro__[1]


def main() -> None:
    """Entry point: bad input is one line on stderr and exit code 2."""
    try:
        sys.exit(app(standalone_mode=False))
    except UserError as error:
        _fail(str(error))
    except typer.Abort:
        _fail("interrupted", 130)
    except _UsageError as error:
        message, context = error.format_message(), error.ctx
        if message.startswith("Usage:"):  # a group without a command shows its help
            print(message)
            sys.exit(2)
        path = context.command_path if context else "harness"
        typed = printable(" ".join(["harness", *sys.argv[1:]]))
        _fail(f"{printable(message, 300)} in `{typed}`; see `{path} --help`")


def _fail(message: str, code: int = 2) -> None:
    print(f"harness: {message}", file=sys.stderr)
    sys.exit(code)
