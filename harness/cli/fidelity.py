"""`harness study fidelity`: frozen against closed-loop."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core.errors import printable

LABEL = 16  # characters of a condition's name that leave its row on one line


def command(
    runs: options.Runs,
    out: Path = typer.Option(Path("reports/fidelity"), help="Folder to write."),
    as_json: options.Json = False,
) -> None:
    """Compare frozen with closed-loop success, paired by episode.

    Give at least one run of `harness eval` and one of `harness drive`, with the same models and layouts.
    """
    from harness.studies import fidelity

    with bar("comparing frozen with closed loop", quiet=as_json):
        result = fidelity.fidelity(runs)
        page = fidelity.write(result, out)
    if as_json:
        typer.echo(result.table.to_json(orient="records"))
        return
    typer.echo(
        f"{'condition':<{LABEL}}{'frozen %':>12}{'closed %':>12}{'difference, points':>28}{'same %':>12}"
    )
    who = ""
    for row in map(fidelity.shown, result.table.to_dict("records")):
        if row["who"] != who:
            who = row["who"]
            typer.echo(printable(who))
        frozen, closed, same = (row[name].partition(" ")[0] for name in ("frozen", "closed", "agreement"))
        label = printable(row["condition"])
        label = f"{label:<{LABEL}}" if len(label) < LABEL else f"{label}\n{'':<{LABEL}}"
        typer.echo(f"{label}{frozen:>12}{closed:>12}{row['difference']:>28}{same:>12}")
    for sentence in fidelity.headline(result):
        typer.echo(sentence)
    typer.echo(f"wrote {printable(page)}")
