"""What a model does with a prompt, as `harness prompt check --model` says it."""

from typing import TYPE_CHECKING, Any

import typer
from msgspec import to_builtins

from harness.cli.progress import bar
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.backends.card import Card
    from harness.evaluate.examine import Findings, Moved
    from harness.evaluate.trial import Trial
    from harness.prompts.versions import Prompt


def asks(prompt: "Prompt", model: str, engine: str | None) -> "Card":
    """Return the card of the model that a prompt is tried on.

    Raises:
        UserError: it is no language model, or the prompt cannot ask the fixed questions.
    """
    from harness.backends.cards import resolve
    from harness.backends.registry import capabilities
    from harness.evaluate import questions
    from harness.prompts import versions as prompts

    card = resolve(model, engine)
    if not capabilities(card.engine).language_model:
        raise UserError(
            f"--model {printable(card.name)}: it reads no prompt; give a language model (`harness model "
            "list`)"
        )
    if reason := prompts.unfit(prompt, questions.scenario()):
        raise UserError(
            f"--model: prompt {prompt.version} {reason}; the fixed questions are of that scenario; leave "
            "--model out"
        )
    return card


def tried(
    prompt: "Prompt", card: "Card", device: str | None, dtype: str | None, quiet: bool
) -> "tuple[Trial, Findings | str | None]":
    """What the model did, in words and in read-outs; None for these where its engine reads none out."""
    from harness.backends.registry import open_backend
    from harness.evaluate.agent import Agent
    from harness.evaluate.examine import COUNT as READ_OUTS
    from harness.evaluate.examine import examine
    from harness.evaluate.trial import COUNT, try_out

    agent = Agent(card, prompt)
    reads_out = "readout" in agent.can.answer_modes and not agent.thinking
    backend = open_backend(card, device=device, dtype=dtype)
    with bar(f"asking {printable(card.name, 30)}", COUNT + reads_out * READ_OUTS, quiet) as progress:
        trial = try_out(backend, agent, progress)
        return trial, examine(backend, agent, progress) if reads_out else None


def as_mapping(trial: "Trial", findings: "Findings | str | None") -> dict[str, Any]:
    """Return the same as plain values."""
    values: dict[str, Any] = to_builtins({"trial": trial, "readout": findings})
    return values


def show(trial: "Trial", findings: "Findings | str | None") -> None:
    """Print it in words."""
    n = trial.roles[0].n
    typer.echo(f"{printable(trial.model)} was asked {n} fixed questions in each role")
    for role in trial.roles:
        typer.echo(
            f"{role.role:<7} {role.readable} of {role.n} readable, {role.strict} strict, "
            f"{role.distinct} distinct"
        )
        for sentence in role.sentences():
            typer.echo(f"        {sentence}")
        typer.echo(f"        such as {printable(role.sample, 70)}")
    _show_moved("pairs", trial.pairs)
    if any(pair.n for pair in trial.pairs) and not any(pair.read for pair in trial.pairs):
        typer.echo("        the ego's answer ignores what differs between the scenes")
    if isinstance(findings, str):
        typer.echo(f"letters no answer: {printable(findings, 300)}")
    elif findings:
        if findings.letters == "cyclic":
            typer.echo(
                "letters the likeliest action of a read-out follows the letter in "
                f"{findings.follows_letter} of {findings.n} questions"
            )
        _show_moved("letters", findings.pairs)


def _show_moved(what: str, pairs: "Sequence[Moved]") -> None:
    for pair in pairs:
        if not pair.n:
            typer.echo(f"{what:<7} {pair.fact} changed: no pair of answers can be read")
            continue
        typer.echo(
            f"{what:<7} {pair.fact} changed: {pair.moved} of {pair.n} answers moved as they should "
            f"({pair.change})"
        )
