"""`harness campaign`: whole studies."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

import typer

from harness.cli.progress import QUIET

if TYPE_CHECKING:
    from harness.backends.base import AnswerMode
    from harness.evaluate.spec import Latency

app = typer.Typer(
    help="Whole studies: the paper's, from one causal simulator, and driven live.", no_args_is_help=True
)


@app.command("paper")
def paper(
    out: Path = typer.Option(
        Path("reports/paper"), help="Folder to write; an earlier study there is replaced."
    ),
    episodes: int = typer.Option(1500, help="Episodes a seed, to compare operating points."),
    sweep_episodes: int = typer.Option(300, help="Episodes a seed at each grid point of a sweep."),
    as_json: bool = typer.Option(False, "--json", help="Print the ledger as JSON."),
    quiet: bool = typer.Option(False, "--quiet", help=QUIET),
) -> None:
    """Every number of the paper beside the calibrated proxy's, and its Figures A and B."""
    from harness.cli.estimates import in_range
    from harness.cli.progress import bar
    from harness.core.errors import printable
    from harness.studies.campaign import run_paper
    from harness.studies.page import shown, tally
    from harness.studies.paper import panels

    in_range("--episodes", episodes, 10, 1_000_000)
    in_range("--sweep-episodes", sweep_episodes, 10, 1_000_000)
    settings = panels(episodes, sweep_episodes)
    with bar(
        "grid points", sum(len(panel.settings) for panel in settings), quiet=as_json or quiet
    ) as progress:
        ledger = run_paper(settings, out, progress)
    if as_json:
        typer.echo(ledger.to_json(orient="records"))
    if as_json or quiet:
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


@app.command("closed-loop")
def closed_loop(
    model: str = typer.Option("swarm-tiny", help="Card, checkpoint directory, .gguf file or hub id."),
    prompt: str = typer.Option("v2", help="Prompt version."),
    answer: str = typer.Option("json", help="json, constrained or readout."),
    episodes: int = typer.Option(300, help="Layouts, each driven under every grid point and seed."),
    first_seed: int = typer.Option(0, help="Layout seed of the first."),
    seeds: str = typer.Option("0:5", help="Seeds of the channel's luck."),
    workers: int = typer.Option(2, help="Processes, each with the model loaded."),
    batch_size: int = typer.Option(8, help="Most prompts that go through the engine together."),
    latency: str | None = typer.Option(None, help="Inference times: card, measured or paper."),
    out: Path | None = typer.Option(None, help="Folder; one that was begun is gone on with."),
    as_json: bool = typer.Option(False, "--json", help="Print the summary as JSON."),
    quiet: bool = typer.Option(False, "--quiet", help=QUIET),
) -> None:
    """The paper's panels driven live in highway-env, and its Figures A and B from that."""
    from harness.backends import cards
    from harness.backends.cache import default_file
    from harness.cli.estimates import in_range
    from harness.cli.evaluate import file_name, parse_seeds
    from harness.cli.progress import bar
    from harness.cli.scenario import MOST_WORKERS
    from harness.cli.sweep import tables
    from harness.core.errors import printable
    from harness.dataset.schema import LAST_EPISODE, LAST_SEED
    from harness.evaluate.live_world import LiveSource
    from harness.evaluate.spec import Spec
    from harness.prompts import versions as prompts
    from harness.studies.closed_loop import panels, run_closed_loop

    in_range("--episodes", episodes, 1, LAST_EPISODE + 1)
    in_range("--first-seed", first_seed, 0, LAST_SEED)
    in_range("--workers", workers, 1, MOST_WORKERS)
    points = {s.point.name: s.point for panel in panels().values() for s in panel}
    spec = Spec(
        cards.resolve(model), prompts.load(prompt), LiveSource(first_seed, episodes),
        tuple(points.values()), parse_seeds(seeds), answer=cast("AnswerMode", answer),
        batch_size=batch_size, latency=cast("Latency | None", latency),
    )  # fmt: skip
    where = out or Path("reports") / f"closed-loop-{file_name(spec.card.name)}-{prompt}"
    with bar("layouts", episodes, quiet=as_json or quiet) as progress:
        summary = run_closed_loop(spec, where, workers, progress, default_file())
    if as_json:
        typer.echo(summary.to_json(orient="records"))
    if as_json or quiet:
        return
    tables(summary)
    typer.echo(f"wrote {printable(where / 'figure-a.svg')} and {printable(where / 'figure-b.svg')}")
