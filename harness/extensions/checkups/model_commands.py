"""`harness model check` and `harness model parity`: a look at a model before a run."""

from dataclasses import asdict
from math import isfinite
from typing import TYPE_CHECKING, Any

import typer
from msgspec import to_builtins

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import echo_json
from harness.core import resources
from harness.core.errors import Unanswered, UserError, printable
from harness.core.resources import DATASET

if TYPE_CHECKING:
    from collections.abc import Mapping

    from harness.backends.base import AnswerMode, Completion, Request
    from harness.backends.card import Card
    from harness.evaluate.spec import Spec
    from harness.extensions.checkups.answers import Checkup
    from harness.extensions.checkups.number_formats import FormatPace
    from harness.extensions.checkups.pace import Pace
    from harness.extensions.checkups.read_outs import Findings


_WIDTH = 100  # of lines of tokens


def check(
    name: str = typer.Argument(
        help="Model: a card name, a checkpoint directory, a .gguf file or a hub id."
    ),
    engine: options.Engine = None,
    thinking: options.Thinking = False,
    device: options.Device = None,
    dtype: options.Dtype = None,
    as_json: options.Json = False,
) -> None:
    """Load a model, show its prompt and time one answer.

    It does so in each answer mode. Twelve fixed questions, and pairs of questions that differ in
    one fact, show whether its read-outs follow the letter and whether it reads the scene; later
    pages of runs asked so say it. A model that takes pictures is also asked with a picture and with
    a blank one. If its card names several engines and its weights are small, each is timed shortly,
    and a line says which is faster here; on a CPU another says how fast each number format is, how
    many prompts are read alike in both, and which is taken. Exit code 1 if no answer can be read,
    or if it ignores the picture; 3 if it answers in no mode.
    """
    from harness.backends.cards import resolve
    from harness.backends.registry import capabilities
    from harness.extensions.checkups import model as checkup
    from harness.extensions.checkups import number_formats
    from harness.extensions.checkups.pace import advice

    card = resolve(name, engine)
    head: dict[str, Any] = {"name": card.name, "engine": card.engine}
    if not capabilities(card.engine).renders:
        if as_json:
            echo_json({**head, "model_free": True})
        else:
            typer.echo(
                f"{card.name}: engine {card.engine} is model-free: no weights, no tokens, nothing "
                "to load"
            )
        return
    with bar(f"asking {printable(card.name, 30)}", grows=True) as progress:
        done = checkup.check(card, thinking, device, dtype, progress)
    spec, seen, who = done.spec, done.seen, printable(card.name)
    if done.unanswered:
        typer.echo(
            f"harness: the fixed questions got no answer: {printable(done.unanswered, 300)}",
            err=True,
        )
    paces = _paces(card)
    formats = _formats(card, seen.identity.get("device"))
    taken, why = number_formats.chosen_format(card, dtype)
    if as_json:
        result = done.findings
        echo_json(
            {
                **head,
                "model_free": False,
                "thinking_asked": spec.ego.thinking,
                **asdict(seen),
                "findings": result and {**to_builtins(result), "reads_scene": result.reads_scene},
                "paces": paces,
                "number_formats": {"measured": formats, "taken": taken, "why": why},
            }
        )
    else:
        _show(spec, seen)
        _show_findings(done.findings)
        if paces:
            typer.echo(f"engines      {advice(paces)}")
        if formats:
            typer.echo(f"formats      {number_formats.advice(formats, taken, why)}")
    errors = [answer.error for answer in done.completions if answer.error is not None]
    if len(errors) == len(done.completions):
        raise Unanswered(f"{printable(errors[0], 300)}: no answer of {who} in any answer mode")
    if seen.looks and seen.looks.fault:
        typer.echo(f"harness: {_blind(card, seen.looks.fault)}", err=True)
        raise typer.Exit(1)
    if not done.usable:
        typer.echo(f"harness: no answer of {who} can be read as a decision", err=True)
        raise typer.Exit(1)


def parity(
    model: str = typer.Argument(
        help="A .gguf file, a card that names both engines, or a folder with a checkpoint and a "
        "GGUF file."
    ),
    prompt: options.Prompt = "v2",
    dataset: options.Dataset = resources.DATASET,
    prompts: int = typer.Option(
        64, help="Number of prompts to compare, spread over scenes and viewers."
    ),
    read_outs: bool = typer.Option(
        False,
        "--read-outs",
        help="Compare tokens and read-outs alone, which takes a fraction of the time.",
    ),
    as_json: options.Json = False,
) -> None:
    """Compare a model's answers on transformers and on llama.cpp.
    Exit code 1 if they differ too much.
    """
    from harness.backends import cards
    from harness.backends.registry import missing
    from harness.dataset import load
    from harness.evaluate.agent import Agent
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.requests import requests
    from harness.evaluate.spec import Spec
    from harness.extensions.checkups.doctor import remedy
    from harness.extensions.checkups.parity import PASSES, compare
    from harness.prompts import versions

    if prompts < 1:
        raise UserError(f"--prompts {prompts}: give 1 or more")
    reference, gguf = cards.resolve(model, "transformers"), cards.resolve(model, "llama-cpp")
    for card in (reference, gguf):
        if lack := missing(card):
            raise UserError(
                f"model {printable(card.name)!r} lacks {lack} on {card.engine}; run "
                f"`{remedy(card, lack)}`"
            )
    data = load.load(load.find(dataset))
    scenes = data.scenes(data.courses())

    def some(answer: "AnswerMode") -> "list[Request]":
        agent = Agent(reference, versions.load(prompt), answer, letters="raw")
        all_requests = list(requests(Spec(agent, FrozenSource(data), (), (0,)), scenes))
        return all_requests[:: max(1, len(all_requests) // prompts)][:prompts]

    json_requests, letters = [] if read_outs else some("json"), some("readout")
    with bar(f"comparing {printable(reference.name, 30)}", PASSES, as_json) as progress:
        compared = compare(reference, gguf, json_requests, letters, progress)
    findings, left_out = compared.findings, compared.left_out
    holds = all(finding.holds for finding in findings)
    if as_json:
        rows = [
            asdict(f) | {"measured": f.measured if isfinite(f.measured) else None} for f in findings
        ]
        echo_json({"holds": holds, "findings": rows, "left_out": left_out})
        raise typer.Exit(0 if holds else 1)
    for f in findings:
        limit = "" if f.allowed is None else f"{f.allowed:g}"
        typer.echo(f"{'ok  ' if f.holds else 'FAIL'} {f.what:<52}{f.measured:>10.5g} {limit:>8}")
        for difference in f.differences:
            typer.echo(f"       {printable(difference, 200)}")
    if left_out:
        typer.echo(f"left out: the same weights in F32 on llama.cpp: {printable(left_out, 300)}")
    verdict = "the engines agree" if holds else "the engines differ"
    typer.echo(f"{verdict}: {len(letters)} prompts; measured, and what is allowed")
    raise typer.Exit(0 if holds else 1)


def _blind(card: "Card", fault: str) -> str:
    """Return what to say of a model that does not see, though its card says so."""
    who, remedy = printable(card.name), "leave [vision] out of its card"
    if card.server:
        who, remedy = f"the server of {who}", f"start it with its projector, or {remedy}"
    return f"{who} {printable(fault, 300)}; {remedy}"


def _paces(card: "Card") -> "list[Pace]":
    """Return how fast a card's engines are here; empty where that cannot be told."""
    from harness.extensions.checkups.pace import paces

    try:
        with bar(f"timing {printable(card.name, 30)}"):
            return paces(card.name.partition(":")[0])
    except (UserError, Unanswered) as error:
        typer.echo(f"harness: its engines are not compared: {printable(error, 300)}", err=True)
        return []


def _formats(card: "Card", device: object) -> "list[FormatPace]":
    """Return how fast a model is in each number format; empty where that cannot be told."""
    from harness.extensions.checkups.number_formats import format_paces

    try:
        with bar(f"timing number formats of {printable(card.name, 30)}"):
            return format_paces(card, device)
    except (UserError, Unanswered) as error:
        typer.echo(f"harness: its formats are not compared: {printable(error, 300)}", err=True)
        return []


def _show(spec: "Spec", seen: "Checkup") -> None:
    from harness.backends.registry import capabilities
    from harness.backends.weights import contradictions
    from harness.extensions.checkups.model import IMAGE_PROMPT, PROMPT

    card, what = spec.ego.card, seen.identity
    where = " on ".join(printable(what[key]) for key in ("dtype", "device") if what.get(key))
    typer.echo(f"model        {printable(card.name)}  {card.engine}  {where}")
    typer.echo(f"licence      {printable(card.licence or 'not in its card')}")
    if capabilities(card.engine).has_weights:
        for difference in contradictions(card):
            typer.echo(f"warning      {difference}")
    if seen.tokens is None:
        why = "the server renders the prompt and counts them" if card.server else "it counts none"
        typer.echo(f"tokens       not known here: {why}")
    else:
        typer.echo(
            f"tokens       {len(seen.tokens)} in the prompt, {seen.bos_tokens} of them BOS at its "
            "beginning"
        )
        if seen.turn_end:
            typer.echo(
                f"answer ends  at {printable(seen.turn_end)}, as its chat template ends a turn"
            )
        else:
            typer.echo(
                "answer ends  at no token of its chat template: it may write on after its answer"
            )
    if card.system:
        typer.echo(
            "system       at the beginning of the first user turn: its template has no place for it"
        )
    typer.echo(
        f"thinking     {seen.thinking or 'as the server is set'}; "
        f"{'asked' if spec.ego.thinking else 'not asked'} here; card: {card.thinking}"
    )
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
        f"letters      {100 * result.letter_share:.0f} % of a read-out follows the letter; the "
        f"likeliest action does in {result.follows_letter} of {result.n} questions; mass on the "
        f"letters {result.label_mass:.2f}"
    )
    moves = ", ".join(
        f"{pair.fact} {pair.moved} of {pair.n} ({pair.change})" for pair in result.pairs
    )
    typer.echo(
        f"pairs        of questions that differ in one fact, letters {result.letters}; the answer "
        f"followed the fact in (mean change of its probability): {moves}"
    )
    for sentence in result.sentences():
        typer.echo(f"             {sentence}")


def _show_answers(answers: "Mapping[AnswerMode, Completion]") -> None:
    for mode, answer in answers.items():
        if answer.error:
            typer.echo(f"{mode:<13}no answer: {printable(answer.error, 300)}")
            continue
        took = "" if answer.seconds is None else f"{answer.seconds * 1000:.1f} ms, "
        if answer.first_token_s is not None and answer.token_s is not None:
            took += f"first token after {answer.first_token_s * 1000:.1f} ms, "
        count = answer.completion_tokens
        tokens = "" if count is None else f"{count} token{'' if count == 1 else 's'}, "
        typer.echo(
            f"{mode:<13}{took}{tokens}{answer.finish_reason}: {printable(repr(answer.text))}"
        )


def _token_lines(tokens: list[tuple[int, str]]) -> list[str]:
    """Return ids with their pieces, as many to a line as fit."""
    lines = [""]
    for number, piece in tokens:
        token = f"{number} {printable(repr(piece), 60)}"
        if lines[-1] and len(lines[-1]) + len(token) > _WIDTH:
            lines.append("")
        lines[-1] += f"  {token}" if lines[-1] else token
    return [line for line in lines if line]
