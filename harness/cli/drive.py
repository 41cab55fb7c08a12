"""`harness drive`: a model with a prompt drives live."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer

from harness.cli.progress import QUIET
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.backends.base import AnswerMode
    from harness.evaluate.run import Evaluated
    from harness.evaluate.spec import Latency, Spec

ALL = "all"


def drive(
    model: str = typer.Option("proxy", help="Card, checkpoint directory, .gguf file, hub id, or a driver."),
    engine: str | None = typer.Option(None, help="Another engine that the card names, such as llama-cpp."),
    prompt: str = typer.Option("v2", help="Prompt version. `harness prompt list`."),
    condition: list[str] = typer.Option(
        [],
        help="Operating point, or a change of one: 6g:consensus=ego-prompt. Repeatable. Default: all.",
    ),
    episodes: int | None = typer.Option(None, help="Layouts to drive. Default: the shipped dataset's."),
    first_seed: int | None = typer.Option(None, help="Layout seed of the first. Default: the dataset's."),
    seeds: str = typer.Option("0:5", help="Seeds of the channel: 0:5 is 0 to 4; or 3,7,9."),
    thinking: bool = typer.Option(False, "--thinking", help="Ask the model to think first."),
    answer: str = typer.Option("json", help="json: free text; constrained: to the schema; readout: letters."),
    batch_size: int = typer.Option(8, help="Most prompts that go through the engine together."),
    workers: int = typer.Option(2, help="Processes, each with the model loaded."),
    device: str | None = typer.Option(None, help="cpu or cuda."),
    dtype: str | None = typer.Option(None, help="float32, bfloat16 or auto, in place of the card's."),
    latency: str | None = typer.Option(
        None,
        help="Inference times: card, measured (batch 1, here) or paper (145 ms). Default: the card's.",
    ),
    out: Path | None = typer.Option(None, help="The run's folder. Default: reports/<model>-<prompt>-drive."),
    resume: bool = typer.Option(False, "--resume", help="Go on with a run that was killed."),
    save_video: int = typer.Option(
        0, help="Draw the first so many failed episodes of the last condition into the run's videos/."
    ),
    no_cache: bool = typer.Option(False, "--no-cache", help="Ask anew for answers that an earlier run had."),
    tag: list[str] = typer.Option([], help="Word to find the run by. Repeatable."),
    as_json: bool = typer.Option(False, "--json", help="Print the summary as JSON on stdout."),
    quiet: bool = typer.Option(False, "--quiet", help=QUIET),
) -> None:
    """Drive live episodes in highway-env, each decision asked at its moment, and write a report."""
    from harness.backends import cards
    from harness.cli.estimates import in_range
    from harness.cli.evaluate import default_out, parse_seeds
    from harness.cli.scenario import MOST_WORKERS
    from harness.coordination.operating_point import POINTS, named_point
    from harness.dataset.schema import LAST_EPISODE, LAST_SEED
    from harness.evaluate.live_world import LiveSource
    from harness.evaluate.spec import Spec
    from harness.prompts import versions as prompts

    if ALL in condition and len(condition) > 1:
        raise UserError(f"--condition {ALL} stands for every operating point; leave the others out")
    shipped = _shipped()
    episodes = shipped["episodes"] if episodes is None else episodes
    first_seed = shipped["seed"] if first_seed is None else first_seed
    in_range("--episodes", episodes, 1, LAST_EPISODE + 1)
    in_range("--first-seed", first_seed, 0, LAST_SEED)
    in_range("--workers", workers, 1, MOST_WORKERS)
    in_range("--save-video", save_video, 0, episodes)
    names = POINTS if condition in ([], [ALL]) else condition
    spec = Spec(
        card=cards.resolve(model, engine),
        prompt=prompts.load(prompt),
        source=LiveSource(first_seed, episodes),
        points=tuple(named_point(name) for name in dict.fromkeys(names)),
        seeds=parse_seeds(seeds),
        thinking=thinking,
        answer=cast("AnswerMode", answer),
        batch_size=batch_size,
        device=device,
        dtype=dtype,
        latency=cast("Latency | None", latency),
        tags=tuple(dict.fromkeys(tag)),
    )
    _run(spec, out or default_out(spec, resume), resume, workers, save_video, no_cache, as_json, quiet)


def _shipped() -> dict[str, Any]:
    from harness.core.resources import DATASET, folder

    manifest: dict[str, Any] = json.loads((folder("datasets") / DATASET / "manifest.json").read_text())
    return manifest


def _run(
    spec: "Spec",
    out: Path,
    resume: bool,
    workers: int,
    save_video: int,
    no_cache: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    from harness.backends.cache import default_file
    from harness.cli.evaluate import as_mapping
    from harness.cli.progress import bar
    from harness.evaluate.run import evaluate

    cache = None if no_cache else default_file()
    episodes = spec.source.episodes
    with bar(f"driving {printable(spec.card.name, 30)}", episodes, quiet=as_json or quiet) as progress:
        done = evaluate(spec, out, resume, progress, cache, workers=workers)
    # They draw with matplotlib, which no episode waits for.
    from harness.cli.report import write
    from harness.cli.video import write_failures

    page = write([out], quiet=as_json or quiet)
    videos = write_failures(out, save_video, quiet=as_json or quiet) if save_video else []
    if as_json:
        typer.echo(json.dumps(as_mapping(done), indent=1))
    if as_json or quiet:
        return
    _table(done)
    if videos:
        typer.echo(f"wrote {out / 'videos'}: {', '.join(video.name for video in videos)}")
    elif save_video:
        typer.echo(f"no episode failed under {printable(spec.points[-1].name)}: no video")
    typer.echo(f"wrote {page}")


def _table(done: "Evaluated") -> None:
    from rich.console import Console
    from rich.table import Table

    from harness.cli.estimates import interval, tell_answers

    console = Console(width=80, markup=False, highlight=False)
    figures = {(s.condition, s.metric): s for s in done.scores if s.interval != "seed means"}
    table = Table(box=None, width=80, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("condition", overflow="fold")
    for heading in ("success % [95 % CI]", "crash", "late", "latency", "missed", "gap", "clear"):
        table.add_column(heading, justify="right", no_wrap=True)
    for point in done.manifest.conditions:
        name = point["name"]

        def cell(metric: str, scale: float = 1.0, unit: str = "", name: str = name) -> str:
            value = figures[name, metric].value
            return "-" if value is None else f"{value * scale:.1f}{unit}"

        success = figures[name, "success_rate"]
        table.add_row(
            name,
            interval(success.value, success.low, success.high, 100),
            cell("collision_rate", 100, " %"),
            cell("late_rate", 100, " %"),
            cell("latency_proxy_ms", 1, " ms"),
            cell("deadline_miss_rate", 100, " %"),
            cell("least_gap_m", 1, " m"),
            cell("time_to_clear_s", 1, " s"),
        )
    m = done.manifest
    console.print(
        f"{printable(m.model['name'], 40)} · prompt {m.prompt['version']} · {m.answer} · driven live"
    )
    console.print(table)
    first, n = m.world.first_seed, m.world.episodes
    console.print(
        f"n = {n} episodes (layout seeds {first} to {first + n - 1}) × "
        f"{len(m.seeds)} channel seeds;\nintervals over episodes; missed: decisions that outlast the "
        "window;\ngap: the least; clear: seconds to clear, where the ego did; both are means"
    )
    tell_answers(console, m, figures)
