"""The command line: parses, calls one function, prints where it wrote.

Heavy packages load inside the commands, so that `harness --help` answers at once.
"""

import sys
from typing import Any

import typer
from typer.main import get_command

from harness.cli import (
    campaign,
    compare,
    dataset,
    distill,
    doctor,
    drive,
    evaluate,
    fidelity,
    init,
    ls,
    model,
    parity,
    parse,
    prompt,
    report,
    scenario,
    shell,
    sweep,
    video,
    view,
)
from harness.core.errors import UserError, printable

COMMANDS: dict[str, dict[str, Any]] = {
    "Evaluate": {
        "eval": evaluate.evaluate,
        "drive": drive.drive,
        "sweep": sweep.sweep,
        "compare": compare.compare,
        "fidelity": fidelity.fidelity,
        "campaign": campaign.app,
    },
    "Look": {
        "ls": ls.ls,
        "view": view.view,
        "report": report.command,
        "video": video.command,
        "parse": parse.command,
    },
    "Data": {
        "init": init.init,
        "prompt": prompt.app,
        "dataset": dataset.app,
        "scenario": scenario.app,
    },
    "Models": {
        "distill": distill.distill,
        "parity": parity.parity,
        "doctor": doctor.doctor,
        "model": model.app,
    },
}

app = typer.Typer(
    name="harness",
    cls=shell.Map,
    help="Evaluate prompts and parsing in cooperative driving.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for panel, commands in COMMANDS.items():
    for name, command in commands.items():
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=panel)
        else:
            app.command(name, rich_help_panel=panel)(command)

# typer carries a click of its own and exports of its errors only this one's children.
_UsageError: Any = typer.BadParameter.__mro__[1]


def main() -> None:
    """Entry point: bad input is one line on stderr and exit code 2."""
    program = get_command(app)
    shell.hasten(program)
    try:
        sys.exit(program(standalone_mode=False))
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
