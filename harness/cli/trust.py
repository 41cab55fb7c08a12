"""`harness trust`: what consensus rules make of helpers that lie or fail."""

from pathlib import Path
from textwrap import fill

import typer

from harness.cli import options
from harness.cli.estimates import WIDTH, echo_json, table
from harness.cli.progress import bar
from harness.core.errors import printable
from harness.core.figures import shown

HEADS = ("rule", "price in peace", "mean of attacks %", "worst attack", "there %")


def command(
    run: Path = typer.Argument(help="Folder of a finished run of `harness eval`.", metavar="RUN"),
    attacks: str = typer.Option(
        "all", help="Attacks, such as liar,liar+spoof,stale:decisions=2. `harness trust --help` lists them."
    ),
    rules: str = typer.Option("all", help="Consensus rules, such as median,trust,linear:weight_cap=0.3."),
    share: str = typer.Option("0,1/3,2/3", help="Shares of the helpers that attack; 0 is always played."),
    condition: str = typer.Option("6g", help="Operating point that is attacked, or a change of one."),
    seeds: str | None = typer.Option(None, help="Seeds of the channel. Default: the run's."),
    no_model: bool = typer.Option(
        False, "--no-model", help="Leave out walks to decision points that the run has no answer for."
    ),
    out: Path | None = typer.Option(None, help="Folder to write. Default: RUN/trust."),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Play every attack against every consensus rule.

    The model is asked only what the run has not. The same command continues a study that was stopped.
    """
    from harness.coordination.attacks import ATTACKS
    from harness.coordination.rules import RULES
    from harness.studies.stored import Stored
    from harness.studies.trust import CAPPED, USUAL, names_of, run_bench, shares_of
    from harness.studies.trust_page import as_json as plain
    from harness.studies.trust_page import in_a_sentence, price, write_bench

    chosen = names_of("--attacks", attacks, USUAL, tuple(ATTACKS))
    ways, parts = names_of("--rules", rules, (*RULES, CAPPED), tuple(RULES)), shares_of(share)
    with bar("rules under attack", quiet=as_json or quiet) as progress:
        stored = Stored(run, more=progress.more, done=progress, asks=not no_model)
        draws = options.parse_seeds(seeds) if seeds else stored.seeds
        where = out or run / "trust"
        bench = run_bench(stored, condition, ways, chosen, parts, draws, where, progress, progress.more)
    page = write_bench(bench, where)
    if as_json:
        echo_json(plain(bench))
    if as_json or quiet:
        return
    typer.echo(f"{printable(bench.name)} · {printable(bench.source)} · {printable(bench.condition)}")
    for sentence in in_a_sentence(bench):
        typer.echo(fill(printable(sentence, 1000), WIDTH))
    for part in bench.shares:
        typer.echo(f"\n{100 * part:.0f} % of the helpers attack")
        rows = []
        for rule in bench.rules:
            worst = bench.worst(rule, part)
            rows.append((
                rule, price(bench, rule), shown(bench.mean(rule, part)), worst,
                shown(bench.success(rule, worst, part)),
            ))  # fmt: skip
        table(HEADS, rows)
    n = bench.price(bench.rules[0]).n
    typer.echo(
        f"n = {n} episodes × {len(draws)} seeds; intervals over episodes; price: points of\n"
        "success against linear while nobody attacks, paired"
    )
    typer.echo(f"wrote {printable(page)}")
