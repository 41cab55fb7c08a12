"""`harness eval`: a model with a prompt on a dataset."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.estimates import echo_json
from harness.cli.progress import bar
from harness.cli.run import Column, as_mapping, default_out, show
from harness.core import resources, work
from harness.core.errors import printable
from harness.core.seeds import stated

if TYPE_CHECKING:
    from harness.dataset.load import Dataset as Frozen
    from harness.evaluate.spec import Spec

COLUMNS = (
    Column("success % [95 % CI]", "success_rate", 100, interval=True),
    Column("gain, points", "success_gain_over_single-local", 100, interval=True),
    Column("latency", "latency_proxy_ms", unit=" ms"),
    Column("trigger", "trigger_rate", 100, " %"),
    Column("msgs", "messages_per_episode"),
)


def command(
    model: str = typer.Option(
        "proxy", help="Card, checkpoint directory, .gguf file, hub id, or replay:RUN. `harness model list`."
    ),
    engine: options.Engine = None,
    prompt: options.ScenarioPrompt = None,
    dataset: options.Dataset = resources.DATASET,
    condition: options.Conditions = None,
    seeds: options.Seeds = "0:5",
    limit: int | None = typer.Option(None, help="The first so many episodes. Default: all."),
    only: str | None = typer.Option(None, help="Episodes by number: 3,10:20 is 3 and 10 to 19."),
    danger: str | None = typer.Option(None, help="Sector its danger comes from, such as left; or none."),
    sample: int | None = typer.Option(None, help="How many episodes to draw of those."),
    sample_seed: int = typer.Option(0, help="Seed of the draw."),
    thinking: options.Thinking = False,
    answer: options.Answer = "json",
    batch_size: options.BatchSize = 8,
    device: options.Device = None,
    dtype: options.Dtype = None,
    latency: options.Latency = None,
    out: Path | None = typer.Option(None, help="Run folder. Default: reports/<model>-<prompt>-<dataset>."),
    no_cache: options.NoCache = False,
    dry_run: bool = typer.Option(False, "--dry-run", help="Render and count, call no model, write nothing."),
    tokenizer: Path | None = typer.Option(None, help="For --dry-run: tokenizer.json, its folder, or a GGUF."),
    tag: options.Tags = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Evaluate a model with a prompt on frozen scenes. The same command continues one that was stopped."""
    from harness.backends import cards
    from harness.backends.cache import default_file
    from harness.coordination.operating_point import POINTS, named_point
    from harness.dataset import load
    from harness.dataset.select import Selection
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.run import evaluate
    from harness.evaluate.spec import Spec
    from harness.prompts import versions

    selection = Selection(limit, only, danger, sample, sample_seed)
    frozen = selection.of(load.load(load.find(dataset), None if selection.given else limit))
    spec = Spec(
        card=cards.resolve(model, engine),
        prompt=versions.load(prompt or frozen.scenario.prompt),
        source=FrozenSource(frozen, selection),
        points=tuple(named_point(name) for name in dict.fromkeys(condition or POINTS)),
        seeds=options.parse_seeds(seeds),
        thinking=thinking,
        answer=answer,
        batch_size=batch_size,
        device=device,
        dtype=dtype,
        latency=latency,
        tags=tuple(dict.fromkeys(tag or ())),
    )
    if dry_run:
        _dry_run(spec, frozen, tokenizer, as_json, quiet)
        return
    folder = out or default_out(spec)
    silent = as_json or quiet
    with bar(f"asking {printable(spec.card.name, 30)}", quiet=silent) as progress:
        cache = None if no_cache else default_file()
        done = evaluate(spec, folder, progress, cache, progress.more)
    from harness.cli.report import write

    with work.going_on(folder):
        page = write([folder], quiet=silent, dataset=frozen)
    work.tidy(folder)
    if as_json:
        echo_json(as_mapping(done))
    if silent:
        return
    seeds_of = frozen.manifest.episodes if selection.given else len(frozen.episodes)
    notes = (
        f"n = {len(frozen.episodes)} episodes × {len(spec.seeds)} channel seeds; "
        f"{'of ' if selection.given else ''}{stated(frozen.manifest.seed, seeds_of)};",
        "intervals over episodes; msgs an episode; gain: over single-local, paired",
    )
    show(done, frozen.name, COLUMNS, notes)
    typer.echo(f"wrote {page}")


def _dry_run(spec: "Spec", dataset: "Frozen", tokenizer: Path | None, as_json: bool, quiet: bool) -> None:
    from harness.backends.tokens import counter, spread_of
    from harness.evaluate.asking import requests

    count = counter(tokenizer, spec.card)
    sizes: dict[str, list[int]] = {}
    asked, scenes = 0, dataset.scenes(dataset.courses())
    for request in requests(spec, scenes):
        asked += 1
        if count:
            sizes.setdefault(request.role, []).append(count(request.messages))
    stats = {role: spread_of(n) for role, n in sizes.items()}
    if as_json:
        echo_json({**spec.settings(), "requests": asked, "prompt_tokens": stats or None})
    if as_json or quiet:
        return
    typer.echo(
        f"{asked} requests for the {len(scenes)} scenes on the reference drivers' courses; would score "
        f"{len(spec.points)} conditions × {len(spec.seeds)} seeds; no model was called"
    )
    for role, s in stats.items():
        typer.echo(f"{role}: {s['least']} to {s['most']} prompt tokens, mean {s['mean']} (n = {s['n']})")
    if not stats:
        typer.echo(
            "prompt tokens: not counted, no tokenizer at hand; give --tokenizer (tokenizer.json or GGUF)"
        )
