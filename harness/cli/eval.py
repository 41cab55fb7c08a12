"""`harness eval`: a model with a prompt on a dataset."""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options, repeats, suite
from harness.cli.estimates import echo_json
from harness.cli.progress import bar
from harness.cli.run import Column, as_mapping, default_out, show
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.seeds import stated
from harness.evaluate.settings import ANSWERS, OUTPUT, FrozenSettings, Settings

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.dataset.load import Dataset as Frozen
    from harness.evaluate.lifecycle import Evaluated
    from harness.evaluate.run import Opens
    from harness.evaluate.spec import Spec

COLUMNS = (
    Column("success % [95 % CI]", "success_rate", interval=True),
    Column("gain, points", "success_gain_over_single-local", interval=True),
    Column("latency", "latency_proxy_ms"),
    Column("trigger", "trigger_rate"),
    Column("msgs", "messages_per_episode"),
)


@options.takes(FrozenSettings)
def command(
    settings: Settings,
    repeat: int | None = typer.Option(
        None,
        "--repeats",
        help="Evaluate this many times, 2 to 100, each with the next sampling seed; needs a --temperature "
        "above 0.",
        rich_help_panel=ANSWERS,
    ),
    workers: options.RuleWorkers = None,
    out: Path | None = typer.Option(
        None, help="Folder to write the run to. Default: reports/<model>-<prompt>-<dataset>."
    ),
    no_cache: options.NoCache = False,
    dry_run: bool = typer.Option(
        False,
        "--dry-run",
        help="Only render the prompts and count requests and tokens; write nothing.",
        rich_help_panel=OUTPUT,
    ),
    tokenizer: Path | None = typer.Option(
        None,
        help="With --dry-run: tokenizer to count with: a tokenizer.json, its folder, or a GGUF file. "
        "Default: the model's.",
        rich_help_panel=OUTPUT,
    ),
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
) -> None:
    """Evaluate a model with a prompt on frozen scenes.

    If the run is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.dataset import load, suites
    from harness.dataset.select import Selection
    from harness.evaluate import resolve
    from harness.evaluate.frozen_world import FrozenSource

    world: Any = settings.world
    named = suites.named(world.dataset)
    selection = Selection(world.limit, world.only, world.danger, world.sample, world.sample_seed)
    frozen = [
        selection.of(load.load(load.find(name), None if selection.given else world.limit))
        for name in (named.datasets if named else (world.dataset,))
    ]
    options.say_all(world.limit, frozen)
    specs = [resolve.spec(settings, FrozenSource(each, selection)) for each in frozen]
    if named:
        suite.check(named, specs)
    if repeat is not None:
        if named:
            raise UserError(
                f"--repeats {repeat}: needs one dataset, and --dataset names a suite; give one of its "
                "datasets"
            )
        repeats.check(specs[0], repeat)
    if dry_run:
        counted = [_counted(*each, tokenizer) for each in zip(specs, frozen, strict=True)]
        if repeat is not None:
            counted[0] |= {"repeats": repeat}
        if as_json:
            echo_json(counted if named else counted[0])
        elif not quiet:
            for each in zip(specs, counted, strict=True):
                _show_counted(*each)
        return
    if workers is not None:
        _refuse_language_models(specs, workers)
    silent, cache = as_json or quiet, None if no_cache else default_file()
    who = options.workers_of(workers or "2")
    evaluated = partial(_evaluated, cache=cache, silent=silent, workers=who)
    if repeat is not None:
        repeats.evaluate(specs[0], repeat, out, cache, quiet, as_json)
        return
    if named:
        suite.evaluate(named, specs, frozen, out, evaluated, quiet, as_json)
        return
    done, page = evaluated(specs[0], frozen[0], out or default_out(specs[0]))
    if as_json:
        echo_json(as_mapping(done))
    if silent:
        return
    from harness.report.references import BESIDE, in_trees, label, meaning

    seeds_of = frozen[0].manifest.episodes if selection.given else len(frozen[0].episodes)
    references = in_trees(frozen[0])
    beside = {name: references[name] for name in BESIDE if name in references}
    notes = (
        f"n = {len(frozen[0].episodes)} episodes × {len(specs[0].seeds)} channel seeds; "
        f"{'of ' if selection.given else ''}{stated(frozen[0].manifest.seed, seeds_of)};",
        "95 % intervals over episodes; msgs: per episode; gain: over single-local, paired",
        *map(meaning, beside),
    )
    rows = {label(name, frozen[0].scenario.name): score for name, score in beside.items()}
    show(done, frozen[0].name, COLUMNS, notes, rows)
    typer.echo(f"wrote {page}")


def _evaluated(
    spec: "Spec", dataset: "Frozen", folder: Path, opens: "Opens | None" = None,
    *, cache: Path | None, silent: bool, workers: "Workers",
) -> "tuple[Evaluated, Path]":  # fmt: skip
    """Evaluate, and write the run and its page."""
    from harness.evaluate.run import evaluate

    with bar(f"asking {printable(spec.ego.card.name, 30)}", quiet=silent, grows=True) as progress:
        done = evaluate(spec, folder, progress, cache, progress.more, workers, opens)
    from harness.cli.report import write

    with work.going_on(folder):
        page = write([folder], quiet=silent, dataset=dataset, workers=workers)
    work.tidy(folder)
    return done, page


def _refuse_language_models(specs: "Sequence[Spec]", workers: str) -> None:
    for agent in (agent for spec in specs for agent in spec.agents):
        if agent.can.language_model:
            raise UserError(
                f"--workers {printable(workers)}: the answers of rules are spread over workers, and "
                f"{printable(agent.card.name)} is a language model; give --batch-size, or several --server"
            )


def _counted(spec: "Spec", dataset: "Frozen", tokenizer: Path | None) -> dict[str, Any]:
    """What would be asked: the settings, how many requests about the scenes, and the tokens of prompts.

    Who asks a helper depends on answers: unless all are asked, helpers are asked as often at most.
    """
    from harness.backends.tokens import counter, summarize_counts
    from harness.evaluate.asking import EGO, requests

    count = counter(tokenizer, spec.ego.card)
    sizes: dict[str, list[int]] = {}
    asked, scenes = Counter[str](), dataset.scenes(dataset.courses())
    sighted = spec.asks_all or any(point.asks and not point.blind_helpers for point in spec.points)
    blind = any(point.blind_helpers and (spec.asks_all or point.asks) for point in spec.points)
    own = requests(spec, scenes, places=None if sighted else [EGO] * len(scenes))
    for request in chain(own, requests(spec, scenes, blind=True) if blind else ()):
        asked[request.role] += 1
        if count:
            vision = spec.agents[request.agent].card.vision if request.image else None
            tokens = count(request.messages) + (vision.tokens if vision else 0)
            sizes.setdefault(request.role, []).append(tokens)
    stats = {role: summarize_counts(n) for role, n in sizes.items()}
    return {
        **spec.settings(), "requests": asked.total(), "requests_by_role": dict(asked),
        "scenes": len(scenes), "prompt_tokens": stats or None,
    }  # fmt: skip


def _show_counted(spec: "Spec", counted: dict[str, Any]) -> None:
    repeated = f" × {counted['repeats']} repeats" if "repeats" in counted else ""
    by_role, requests = counted["requests_by_role"], f"{counted['requests']} requests"
    if "helper" in by_role and not spec.asks_all:
        requests = f"{by_role['ego']} requests to the ego and at most {by_role['helper']} to helpers"
    typer.echo(
        f"{spec.source.name}: {requests}{repeated} for the {counted['scenes']} scenes "
        f"on the reference drivers' courses; would score {len(spec.points)} conditions × {len(spec.seeds)} "
        "channel seeds; no model was called"
    )
    for role, s in (counted["prompt_tokens"] or {}).items():
        typer.echo(f"{role}: {s['least']} to {s['most']} prompt tokens, mean {s['mean']} (n = {s['n']})")
    if not counted["prompt_tokens"]:
        typer.echo("prompt tokens not counted: no tokenizer here; give --tokenizer (tokenizer.json or GGUF)")
