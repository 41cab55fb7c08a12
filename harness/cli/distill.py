"""`harness model distill`: train a small language model in some scenarios."""

import time
from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.scenario import ready_to_drive
from harness.core import extras
from harness.core.errors import UserError, printable
from harness.core.seeds import FIRST, purpose, stated

SAMPLES = "60000,160000,30000,50000"
BATCH = 16


def command(
    scenario: list[str] = typer.Argument(
        help="Scenarios to learn; `harness dataset scenario list` shows them."
    ),
    out: Path = typer.Option(..., help="Folder to make; its name becomes the model's name."),
    prompt: list[str] = typer.Option(
        ["v2", "v4"], help="Prompt version to learn; it is used in the scenarios that it fits. Repeatable."
    ),
    base: Path | None = typer.Option(
        None,
        help="Folder of a distilled text model to start from; its tokenizer is kept. Default: from scratch.",
    ),
    layouts: int = typer.Option(240, help="Number of layouts of each scenario."),
    first_seed: int = typer.Option(
        FIRST["train"], help="Layout seed of the first layout; train seeds are 100000 to 199999."
    ),
    samples: str = typer.Option(
        SAMPLES, help="Training sequences of the four stages excerpts, alone, messages and answers."
    ),
    seed: int = typer.Option(0, help="Seed of the initial weights and of the order of the sequences."),
    batch: int = typer.Option(BATCH, help="Sequences per training step."),
    device: str = typer.Option("cpu", help="Where to train: cpu, cuda or cuda:N."),
    threads: int | None = typer.Option(None, help="Number of CPU threads. Default: PyTorch's choice."),
    workers: options.Workers = "2",
) -> None:
    """Train a small Qwen3 to imitate the planner in some scenarios.

    With an image prompt it is a Qwen3-VL, which takes pictures and text. If the training is stopped, the same
    command continues it.
    """
    from harness.prompts import versions as prompts

    extras.need("harness model distill", "torch", "transformers", "highway_env")
    for flag, value, least in (("--batch", batch, 1), ("--threads", threads, 1), ("--seed", seed, 0)):
        if value is not None and value < least:
            raise UserError(f"{flag} {value}: give {least} or more")
    if base and not all((base / name).is_file() for name in ("model.safetensors", "tokenizer.json")):
        raise UserError(
            f"--base {printable(base)}: no model.safetensors with a tokenizer.json; give the folder of a "
            "model that `harness model distill` made"
        )
    versions = [prompts.load(version) for version in dict.fromkeys(prompt)]
    driven = [ready_to_drive(name, layouts, first_seed) for name in dict.fromkeys(scenario)]
    if purpose(first_seed, layouts) != "train":
        raise UserError(
            f"--first-seed {first_seed}: {stated(first_seed, layouts)}; a model learns from train seeds "
            f"alone, {FIRST['train']} to {FIRST['report'] - 1}"
        )
    learnt = {each: tuple(v for v in versions if not prompts.unfit(v, each)) for each in driven}
    for each, some in learnt.items():
        if not some:
            raise UserError(
                f"--prompt {printable(' '.join(prompt))}: none is for {each.name}; give {each.prompt}, or "
                "one of your own"
            )
    # A stage has a batch at least, and that of messages takes a scene for four sequences of each prompt.
    counts = _counts(samples, max(batch, 4 * sum(map(len, learnt.values()))))

    from harness.backends.transformers.engine import choose_device
    from harness.training.distill import Curriculum
    from harness.training.distill import distill as run
    from harness.training.train import STAGES, Plan

    plan = Plan(dict(zip(STAGES, counts, strict=True)), batch=batch, seed=seed)
    begun_s = time.monotonic()
    drawn = layouts * len(learnt)
    with bar("drawing layouts", drawn) as progress:

        def show(stage: str, seen: int, loss: float) -> None:
            progress.label = f"{stage} loss {loss:.3f}"
            progress.more(drawn + sum(counts) - progress.total)
            progress(drawn + sum(counts[: STAGES.index(stage)]) + seen - progress.done)

        facts = run(
            Curriculum(learnt, layouts, first_seed, base), plan, out, progress, show, choose_device(device),
            threads, options.workers_of(workers),
        )  # fmt: skip
    for apart in facts["held_out"]:
        typer.echo(
            f"{apart['scenario']}: held-out KL {apart['kl_nats']:.3f} nats (mean label "
            f"{apart['kl_of_the_mean_nats']:.3f}, n = {apart['questions']})"
        )
    typer.echo(
        f"wrote {printable(out)}: {facts['parameters']:,} parameters, {time.monotonic() - begun_s:.0f} s"
    )


def _counts(text: str, least: int) -> list[int]:
    """Return four numbers of sequences, none below `least`."""
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if len(counts) != len(SAMPLES.split(",")) or min(counts) < least:
        raise UserError(
            f"--samples {printable(text)}: give four whole numbers, such as {SAMPLES}, {least} or more each"
        )
    return counts
