"""`harness campaign`: whole studies."""

from pathlib import Path

import typer

app = typer.Typer(help="Whole studies: the paper's, from one causal simulator.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """A group of commands, also while it has one."""


@app.command("paper")
def paper(
    out: Path = typer.Option(
        Path("reports/paper"), help="Folder to write; an earlier study there is replaced."
    ),
    episodes: int = typer.Option(1500, help="Episodes a seed, to compare operating points."),
    sweep_episodes: int = typer.Option(300, help="Episodes a seed at each grid point of a sweep."),
    as_json: bool = typer.Option(False, "--json", help="Print the ledger as JSON."),
) -> None:
    """Every number of the paper beside the calibrated proxy's, and its Figures A and B."""
    from harness.cli.estimates import in_range
    from harness.cli.progress import bar
    from harness.errors import printable
    from harness.study.campaign import run_paper
    from harness.study.page import shown, tally
    from harness.study.paper import panels

    in_range("--episodes", episodes, 10, 1_000_000)
    in_range("--sweep-episodes", sweep_episodes, 10, 1_000_000)
    settings = panels(episodes, sweep_episodes)
    with bar("grid points", sum(len(panel.settings) for panel in settings), quiet=as_json) as progress:
        ledger = run_paper(settings, out, progress)
    if as_json:
        typer.echo(ledger.to_json(orient="records"))
        return
    typer.echo(f"{'row':<4}{'what':<31}{'paper':>13}{'ours [95 % CI]':>21}{'off':>6}")
    for row in map(shown, ledger[ledger.kind != "cited"].itertuples()):
        fitted = "    *" if row["kind"] == "fitted" else ""
        mark = {"misses": " MISS", "unclear": "    ?"}.get(row["verdict"], fitted)
        typer.echo(
            f"{row['id']:<4}{row['what'][:30]:<31}{row['paper']:>13}{row['ours']:>21}{row['off']:>6}{mark}"
        )
    found = tally(ledger)
    typer.echo(
        f"{found['within']} of {found['total']} numbers within the aim, {found['misses']} miss it, "
        f"{found['unclear']} unclear (?:\nthe interval reaches it, more --episodes would tell); "
        f"{found['predicted']} predicted, * fitted"
    )
    typer.echo(f"wrote {printable(out / 'index.html')}")
