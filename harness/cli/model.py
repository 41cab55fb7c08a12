"""`harness model`: the models at hand, and a look at one before a run."""

import json
from dataclasses import asdict

import typer

from harness.errors import printable

app = typer.Typer(help="List models, or look at one before a run.", no_args_is_help=True)


@app.command("list")
def list_models(as_json: bool = typer.Option(False, "--json", help="Print the cards as JSON.")) -> None:
    """List the model cards, and which of them can run here."""
    from harness import cards
    from harness.backends.registry import missing

    rows = [(card, missing(card)) for card in map(cards.load, cards.names())]
    if as_json:
        typer.echo(json.dumps([{**asdict(card), "missing": lack} for card, lack in rows], indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, width=80, pad_edge=False)
    for heading in ("name", "engine", "thinking", "latency", "runs here"):
        table.add_column(heading, no_wrap=True)
    table.add_column("description")
    for card, lack in rows:
        seconds = card.latency.inference_s
        latency = "measured" if seconds is None else f"card {seconds * 1000:g} ms"
        here = f"no: {lack}" if lack else "yes"
        table.add_row(card.name, card.engine, card.thinking, latency, here, card.description)
    Console(width=80, markup=False, highlight=False).print(table)


@app.command()
def check(
    name: str = typer.Argument(help="Card, checkpoint directory or hub id."),
    thinking: bool = typer.Option(False, "--thinking", help="Ask the model to think first."),
    device: str | None = typer.Option(None, help="cpu, cuda or cuda:N; CUDA if there is any."),
    dtype: str | None = typer.Option(None, help="float32, bfloat16 or auto, in place of the card's."),
    as_json: bool = typer.Option(False, "--json", help="Print what was seen as JSON."),
) -> None:
    """Load a model, show the prompt that it reads, and time one answer."""
    from harness.cards import resolve

    card = resolve(name)
    if card.engine != "transformers":
        if as_json:
            typer.echo(json.dumps({"name": card.name, "engine": card.engine, "model_free": True}, indent=2))
        else:
            typer.echo(
                f"{card.name}: engine {card.engine} is model-free: no weights, no tokens, nothing to load"
            )
        return
    from harness.backends import checkup, transformers_engine

    backend = transformers_engine.open(card, device=device, dtype=dtype, batch_size=1)
    seen = checkup.check(backend, thinking=thinking)
    if as_json:
        head = {"name": card.name, "engine": card.engine, "model_free": False, "thinking_asked": thinking}
        typer.echo(json.dumps({**head, **asdict(seen)}, indent=2))
        return
    answer, what = seen.completion, seen.identity
    typer.echo(f"model      {card.name}  {what['dtype']} on {what['device']}")
    typer.echo(f"tokens     {seen.prompt_tokens} in the prompt, {seen.bos_tokens} of them BOS")
    typer.echo(
        f"thinking   {seen.thinking}; {'asked' if thinking else 'not asked'} here; card: {card.thinking}"
    )
    typer.echo("prompt")
    for line in seen.prompt.split("\n"):
        typer.echo(f"  | {printable(line, 1000)}")
    typer.echo(f"answer     {printable(answer.error or repr(answer.text))}")
    if answer.seconds is not None:
        typer.echo(
            f"time       {answer.seconds * 1000:.1f} ms for {answer.completion_tokens} tokens, "
            f"asked alone, {answer.finish_reason}"
        )
