"""`harness prompt check`: every prompt of every scene, its tokens,
and what a model does with it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import typer
from msgspec import to_builtins

from harness.cli import options, pictures
from harness.cli.progress import bar
from harness.cli.prompt import NOT_COUNTED, Asked, Tokenizer, Version
from harness.cli.terminal import echo_json
from harness.core import resources
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.extensions.checkups.prompt import Trial
    from harness.extensions.checkups.read_outs import Findings, Moved


def check(
    version: Version,
    dataset: options.Dataset = resources.DATASET,
    tokenizer: Tokenizer = None,
    model: Asked = None,
    engine: options.Engine = None,
    device: options.Device = None,
    dtype: options.Dtype = None,
    as_json: options.Json = False,
) -> None:
    """Render every prompt of every scene and count its tokens.
    Exit code 1 if one is outside the budget.

    The ego's fusion call is rendered with the messages of one helper, of two helpers, and so on to
    all. A repair turn is counted with the longest answer that a role may give. A picture counts as
    many tokens as the model's card says; the exit code is also 1 if the model's own image processor
    is installed and makes another number.

    With --model, the model is asked twelve fixed questions in each role, and pairs of scenes that
    differ in one fact. What it does with the prompt is said in words: whether it copies
    placeholders or examples, sums wrongly, runs to the limit, follows the letter of a read-out,
    ignores the scene. The questions are of tune layouts. An image prompt is not asked.
    """
    from harness.backends.tokens import counter, summarize_counts
    from harness.dataset import load
    from harness.evaluate.agent import example_actions
    from harness.extensions.checkups import prompt as trial
    from harness.prompts import versions as prompts
    from harness.prompts.budget import REPAIR, measure

    prompt, data = prompts.load(version), load.load(load.find(dataset))
    if reason := prompts.unfit(prompt, data.scenario):
        raise UserError(f"prompt {version} {reason}; give another --dataset, or fix the prompt")
    scenes = data.scenes(data.courses())
    reader = pictures.picture_model(prompt, model, checked=True)
    card_to_ask = trial.card_of(prompt, model, engine) if model and reader is None else None
    if difference := reader and reader.difference:
        typer.echo(difference)
        raise typer.Exit(1)
    card, picture = (reader.card, reader.vision.tokens) if reader else (None, 0)
    count = counter(tokenizer, card)
    for role in prompts.ROLES:
        example_actions(prompt, role, data.actions)
    with bar("scenes", len(scenes), as_json) as progress:
        sizes = measure(prompt, data, scenes, count, picture, progress)
    tried = None
    if card_to_ask:
        with bar(f"asking {printable(card_to_ask.name, 30)}", quiet=as_json) as progress:
            tried = trial.try_on(prompt, card_to_ask, device, dtype, progress)
    stats = {call: summarize_counts(tokens) for call, tokens in sizes.tokens.items() if tokens}
    if as_json:
        outside = [each._asdict() for each in sizes.outside]
        figures = {
            "version": version,
            "budget": prompt.token_budget,
            "tokens": stats,
            "outside": outside,
        }
        seen = {"picture": {**reader.as_mapping(), "checked": reader.checked}} if reader else {}
        of_model = to_builtins(dict(zip(("trial", "readout"), tried, strict=True))) if tried else {}
        echo_json({**figures, **seen, **of_model}, indent=None)
    else:
        least, most = prompt.token_budget
        typer.echo(
            f"{version}: renders for every viewer of {len(scenes)} scenes; budget {least} to "
            f"{most} tokens"
        )
        if reader:
            here = "as its processor says" if reader.checked else "its processor is not here to ask"
            typer.echo(f"picture {reader.picture}, {here}")
        for call, s in stats.items():
            typer.echo(
                f"{call:<7} {s['least']} to {s['most']} tokens, mean {s['mean']}, n = {s['n']}"
            )
        if not count:
            typer.echo(NOT_COUNTED)
        if sizes.outside:
            total = sum(map(len, sizes.tokens.values()))
            typer.echo(
                f"outside the budget: {len(sizes.outside)} of {total} prompts; the first are"
            )
        for each in sizes.outside[:10]:
            messages = f" with messages of {each.messages}" if each.messages else ""
            repair = " with a repair turn" if each.call == REPAIR else ""
            typer.echo(
                f"scene {each.scene} viewer {each.viewer}{messages}{repair}: {each.tokens} tokens"
            )
        if tried:
            _show_trial(*tried)
    if sizes.outside:
        raise typer.Exit(1)


def _show_trial(trial: "Trial", findings: "Findings | str | None") -> None:
    """Print what a model does with a prompt, in words and in read-outs."""
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
    readable, of = sum(role.readable for role in trial.roles), n * len(trial.roles)
    typer.echo(
        f'its card may say: prompts = [{{ version = "{trial.prompt}", read = {readable}, '
        f"asked = {of} }}]"
    )
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
