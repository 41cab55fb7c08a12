"""`harness fidelity`: frozen against closed."""

from pathlib import Path

import typer


def fidelity(
    runs: list[Path] = typer.Argument(
        help="Folders of `harness eval` and of `harness drive`; models may be several.", metavar="RUN..."
    ),
    out: Path = typer.Option(Path("reports/fidelity"), help="Folder to write."),
    as_json: bool = typer.Option(False, "--json", help="Print the table as JSON."),
) -> None:
    """How far success on frozen scenes is that of driving, episode by episode."""
    from harness.core.errors import printable
    from harness.studies import fidelity_page
    from harness.studies.fidelity import fidelity as compared

    found = compared(runs)
    page = fidelity_page.write(found, out)
    if as_json:
        typer.echo(found.table.to_json(orient="records"))
        return
    typer.echo(f"{'condition':<16}{'frozen %':>12}{'closed %':>12}{'difference, points':>28}{'same %':>12}")
    who = ""
    for row in map(fidelity_page.shown, found.table.to_dict("records")):
        if row["who"] != who:
            who = row["who"]
            typer.echo(printable(who))
        means = {name: row[name].partition(" ")[0] for name in ("frozen", "closed", "agreement")}
        label = printable(row["condition"])
        label = f"{label:<16}" if len(label) < 16 else f"{label}\n{'':<16}"
        numbers = f"{means['frozen']:>12}{means['closed']:>12}{row['difference']:>28}{means['agreement']:>12}"
        typer.echo(label + numbers)
    for sentence in fidelity_page.headline(found):
        typer.echo(sentence)
    typer.echo(f"wrote {printable(page)}")
