"""The command line: parses, calls one function, prints where it wrote.

Heavy packages load inside the commands, so that `harness --help` answers at once.
"""

import sys

import typer

from harness.cli import dataset, scenario
from harness.errors import UserError

app = typer.Typer(
    name="harness",
    help="Evaluate prompts and parsing in cooperative driving.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(scenario.app, name="scenario")
app.add_typer(dataset.app, name="dataset")


def main() -> None:
    """Entry point: bad input is one line on stderr and exit code 2."""
    try:
        app()
    except UserError as error:
        print(f"harness: {error}", file=sys.stderr)
        sys.exit(2)
