"""`harness eval`: a model with a prompt on a dataset."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
import typer

from harness.cli.progress import QUIET
from harness.core import resources
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.backends.base import AnswerMode
    from harness.evaluate.run import Evaluated
    from harness.evaluate.spec import Latency, Spec

MOST_SEEDS = 1000


def evaluate(
    model: str = typer.Option(
        "proxy", help="Card, checkpoint directory, .gguf file, hub id, or replay:RUN. `harness model list`."
    ),
    engine: str | None = typer.Option(None, help="Another engine that the card names, such as llama-cpp."),
    prompt: str = typer.Option("v2", help="Prompt version. `harness prompt list`."),
    dataset: str = typer.Option(resources.DATASET, help="Shipped dataset, or a dataset's folder."),
    condition: list[str] = typer.Option(
        [],
        help="Operating point, or a change of one: 6g:consensus=ego-prompt. Repeatable. Default: all.",
    ),
    seeds: str = typer.Option("0:5", help="Seeds of the channel: 0:5 is 0 to 4; or 3,7,9."),
    limit: int | None = typer.Option(None, help="Only the dataset's first so many episodes."),
    thinking: bool = typer.Option(False, "--thinking", help="Ask the model to think first."),
    answer: str = typer.Option("json", help="json: free text; constrained: to the schema; readout: letters."),
    batch_size: int = typer.Option(8, help="Most prompts that go through the engine together."),
    device: str | None = typer.Option(None, help="cpu or cuda."),
    dtype: str | None = typer.Option(None, help="float32, bfloat16 or auto, in place of the card's."),
    latency: str | None = typer.Option(
        None,
        help="Inference times: card, measured (batch 1, here) or paper (145 ms). Default: the card's.",
    ),
    out: Path | None = typer.Option(
        None, help="The run's folder. Default: reports/<model>-<prompt>-<dataset>."
    ),
    resume: bool = typer.Option(False, "--resume", help="Go on with a run that was killed."),
    no_cache: bool = typer.Option(False, "--no-cache", help="Ask anew for answers that an earlier run had."),
    dry_run: bool = typer.Option(False, "--dry-run", help="Render and count, call no model, write nothing."),
    tokenizer: Path | None = typer.Option(None, help="For --dry-run: tokenizer.json, its folder, or a GGUF."),
    tag: list[str] = typer.Option([], help="Word to find the run by. Repeatable."),
    as_json: bool = typer.Option(False, "--json", help="Print the summary as JSON on stdout."),
    quiet: bool = typer.Option(False, "--quiet", help=QUIET),
) -> None:
    """Evaluate a model with a prompt on frozen scenes, and write a report."""
    from harness.backends import cards
    from harness.coordination.operating_point import POINTS, named_point
    from harness.dataset import load
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.spec import Spec
    from harness.prompts import versions as prompts

    if limit is not None and limit < 1:
        raise UserError(f"--limit {limit}: give 1 or more episodes")
    spec = Spec(
        card=cards.resolve(model, engine),
        prompt=prompts.load(prompt),
        source=FrozenSource(load.load(load.find(dataset), limit), limit),
        points=tuple(named_point(name) for name in dict.fromkeys(condition or POINTS)),
        seeds=parse_seeds(seeds),
        thinking=thinking,
        answer=cast("AnswerMode", answer),
        batch_size=batch_size,
        device=device,
        dtype=dtype,
        latency=cast("Latency | None", latency),
        tags=tuple(dict.fromkeys(tag)),
    )
    if dry_run:
        _dry_run(spec, tokenizer, as_json, quiet)
        return
    _run(spec, out or default_out(spec, resume), resume, no_cache, as_json, quiet)


def _run(spec: "Spec", out: Path, resume: bool, no_cache: bool, as_json: bool, quiet: bool) -> None:
    from harness.backends.cache import default_file
    from harness.cli.progress import bar
    from harness.evaluate.asking import request_count
    from harness.evaluate.run import evaluate as evaluate_run

    count = request_count(spec, spec.source.dataset.scenes)
    with bar(f"asking {printable(spec.card.name, 30)}", count, as_json or quiet) as progress:
        cache = None if no_cache else default_file()
        done = evaluate_run(spec, out, resume, progress, cache, progress.more)
    from harness.cli.report import write

    page = write([out], quiet=as_json or quiet)
    if as_json:
        typer.echo(json.dumps(as_mapping(done), indent=1))
    if as_json or quiet:
        return
    _table(done)
    typer.echo(f"wrote {page}")


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from `0:5` (0 to 4) or `3,7,9`."""
    start, colon, stop = text.partition(":")
    try:
        # A range is counted before it is made: 0:99999999999 would not fit into memory.
        most = int(start) + MOST_SEEDS + 1 if colon else 0
        seeds = tuple(range(int(start), min(int(stop), most)) if colon else map(int, text.split(",")))
    except ValueError:
        seeds = ()
    if not 0 < len(seeds) <= MOST_SEEDS:
        raise UserError(
            f"--seeds {printable(text)}: give a range such as 0:5, or a list such as 3,7,9, "
            f"of {MOST_SEEDS} seeds at most"
        )
    return seeds


def file_name(model: str) -> str:
    """A model's name as part of a folder's."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in model).strip(".-") or "model"


def default_out(spec: "Spec", resume: bool) -> Path:
    """The first folder of the run's name under reports/ that is free; with `resume`, the last that is not."""
    safe = file_name(spec.card.name)
    mode = "" if spec.answer == "json" else f"-{spec.answer}"
    base = Path("reports") / f"{safe}-{spec.prompt.version}{mode}-{spec.source.name}"
    found, number = base, 1
    last = base
    while found.exists():
        last, number = found, number + 1
        found = base.with_name(f"{base.name}-{number}")
    return last if resume else found


def as_mapping(done: "Evaluated") -> dict[str, Any]:
    """A finished run for machines: its folder and the rows of its summary."""
    return {
        "run": str(done.out),
        "manifest": msgspec.to_builtins(done.manifest),
        "summary": [{**done.manifest.of_run, **msgspec.to_builtins(score)} for score in done.scores],
    }


def _table(done: "Evaluated") -> None:
    from rich.console import Console
    from rich.table import Table

    from harness.cli.estimates import interval, tell_answers

    console = Console(width=80, markup=False, highlight=False)
    figures = {(s.condition, s.metric): s for s in done.scores if s.interval != "seed means"}
    table = Table(box=None, width=80, pad_edge=False)
    table.add_column("condition", overflow="fold")
    for heading in ("success % [95 % CI]", "gain, points", "latency", "trigger", "msgs"):
        table.add_column(heading, justify="right", no_wrap=True)
    for point in done.manifest.conditions:
        name = point["name"]

        def cell(metric: str, scale: float = 1.0, ends: bool = False, name: str = name) -> str:
            r = figures.get((name, metric))
            if r is None or r.value is None:
                return "-"
            return interval(r.value, r.low, r.high, scale) if ends else f"{r.value * scale:.1f}"

        table.add_row(
            name,
            cell("success_rate", 100, True),
            cell("success_gain_over_single-local", 100, True),
            f"{cell('latency_proxy_ms')} ms",
            f"{cell('trigger_rate', 100)} %",
            cell("messages_per_episode"),
        )
    m = done.manifest
    console.print(
        f"{printable(m.model['name'], 40)} · prompt {m.prompt['version']} · {m.answer} · {m.world.name}"
    )
    console.print(table)
    n = m.world.episodes
    console.print(
        f"n = {n} episodes × {len(m.seeds)} channel seeds; intervals over episodes; msgs an episode;"
    )
    console.print("gain is over single-local, paired by episode")
    tell_answers(console, m, figures)


def _dry_run(spec: "Spec", tokenizer: Path | None, as_json: bool, quiet: bool) -> None:
    from harness.backends.tokens import counter, spread_of
    from harness.evaluate.asking import requests

    count = counter(tokenizer, spec.card)
    sizes: dict[str, list[int]] = {}
    asked = 0
    for request in requests(spec, spec.source.dataset.scenes):
        asked += 1
        if count:
            sizes.setdefault(request.role, []).append(count(request.messages))
    stats = {role: spread_of(n) for role, n in sizes.items()}
    if as_json:
        typer.echo(
            json.dumps({**spec.settings(), "requests": asked, "prompt_tokens": stats or None}, indent=1)
        )
    if as_json or quiet:
        return
    scenes = len(spec.source.dataset.scenes)
    typer.echo(f"{asked} requests for {scenes} scenes; would score {len(spec.points)} conditions × "
               f"{len(spec.seeds)} seeds; no model was called")  # fmt: skip
    for role, s in stats.items():
        typer.echo(f"{role}: {s['least']} to {s['most']} prompt tokens, mean {s['mean']} (n = {s['n']})")
    if not stats:
        typer.echo(
            "prompt tokens: not counted, no tokenizer at hand; give --tokenizer (tokenizer.json or GGUF)"
        )
