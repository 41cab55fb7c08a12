"""`harness model parity`: one model through two engines."""

from dataclasses import asdict
from math import isfinite
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import echo_json
from harness.core import resources
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.backends.base import AnswerMode, Request


def command(
    model: str = typer.Argument(
        help="A .gguf file, a card that names both engines, or a folder with a checkpoint and a GGUF file."
    ),
    prompt: options.Prompt = "v2",
    dataset: options.Dataset = resources.DATASET,
    prompts: int = typer.Option(64, help="Number of prompts to compare, spread over scenes and viewers."),
    read_outs: bool = typer.Option(
        False, "--read-outs", help="Compare tokens and read-outs alone, which takes a fraction of the time."
    ),
    as_json: options.Json = False,
) -> None:
    """Compare a model's answers on transformers and on llama.cpp. Exit code 1 if they differ too much."""
    from harness.backends import cards
    from harness.backends.registry import missing
    from harness.dataset import load
    from harness.evaluate.agent import Agent
    from harness.evaluate.asking import requests
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.spec import Spec
    from harness.prompts import versions
    from harness.training.parity import PASSES, compare

    if prompts < 1:
        raise UserError(f"--prompts {prompts}: give 1 or more")
    reference, gguf = cards.resolve(model, "transformers"), cards.resolve(model, "llama-cpp")
    for card in (reference, gguf):
        if lack := missing(card):
            raise UserError(
                f"model {printable(card.name)!r} lacks {lack} on {card.engine}; see `harness model check`"
            )
    data = load.load(load.find(dataset))
    scenes = data.scenes(data.courses())

    def some(answer: "AnswerMode") -> "list[Request]":
        agent = Agent(reference, versions.load(prompt), answer, letters="raw")
        asked = list(requests(Spec(agent, FrozenSource(data), (), (0,)), scenes))
        return asked[:: max(1, len(asked) // prompts)][:prompts]

    asked, letters = [] if read_outs else some("json"), some("readout")
    with bar(f"comparing {printable(reference.name, 30)}", PASSES, as_json) as progress:
        compared = compare(reference, gguf, asked, letters, progress)
    findings, left_out = compared.findings, compared.left_out
    holds = all(finding.holds for finding in findings)
    if as_json:
        rows = [asdict(f) | {"measured": f.measured if isfinite(f.measured) else None} for f in findings]
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
