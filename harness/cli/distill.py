"""`harness distill`: train a small language model on a frozen dataset."""

import time
from pathlib import Path

import typer

from harness.cli.progress import bar
from harness.core import extras
from harness.core.errors import UserError, printable
from harness.core.seeds import FIRST, purpose, stated

SAMPLES = "60000,110000,16000,40000"
BATCH = 16


def command(
    dataset: str = typer.Argument(help="A dataset's folder: what the model learns from.", metavar="DIR"),
    out: Path = typer.Option(..., help="Folder to make; its name becomes the model's."),
    prompt: list[str] = typer.Option(["v1", "v2"], help="Prompt version to learn; repeat for several."),
    samples: str = typer.Option(SAMPLES, help="Sequences a stage: excerpts, alone, messages, answers."),
    seed: int = typer.Option(0, help="Seed of the weights and of the order."),
    batch: int = typer.Option(BATCH, help="Sequences a step."),
    device: str = typer.Option("cpu", help="cpu or cuda."),
    threads: int | None = typer.Option(None, help="Threads on a CPU. Default: PyTorch's choice."),
) -> None:
    """Train a small Qwen3 on a frozen dataset. The same command again continues training that was stopped."""
    from harness.dataset import load
    from harness.prompts import versions as prompts

    extras.need("harness distill", "torch", "transformers")
    for flag, value, least in (("--batch", batch, 1), ("--threads", threads, 1), ("--seed", seed, 0)):
        if value is not None and value < least:
            raise UserError(f"{flag} {value}: give {least} or more")
    versions = [prompts.load(version) for version in dict.fromkeys(prompt)]
    # A stage has a batch at least, and that of messages takes a scene for four sequences of each prompt.
    counts = _counts(samples, max(batch, 4 * len(versions)))
    data = load.load(load.find(dataset))
    seeds = data.manifest.seed, data.manifest.episodes
    if purpose(*seeds) != "train":
        raise UserError(
            f"{printable(dataset)} has {stated(*seeds)}; a model learns from train seeds alone: "
            f"`harness dataset build {data.scenario.name} --seed {FIRST['train']}`"
        )

    from harness.backends.transformers.engine import device_of
    from harness.training.distill import distill as run
    from harness.training.train import STAGES, Plan

    plan = Plan(dict(zip(STAGES, counts, strict=True)), batch=batch, seed=seed)
    begun_s = time.monotonic()
    with bar("training", sum(counts)) as progress:

        def show(stage: str, seen: int, loss: float) -> None:
            progress.label = f"{stage} loss {loss:.3f}"
            progress(sum(counts[: STAGES.index(stage)]) + seen - progress.done)

        facts = run(data, versions, plan, out, show, device_of(device), threads)
    apart = facts["held_out"]
    typer.echo(
        f"held-out KL {apart['kl_nats']:.3f} nats (mean label {apart['kl_of_the_mean_nats']:.3f}, "
        f"n = {apart['questions']})\n"
        f"wrote {printable(out)}: {facts['parameters']:,} parameters, {time.monotonic() - begun_s:.0f} s"
    )


def _counts(text: str, least: int) -> list[int]:
    """Four numbers of sequences, none below `least`."""
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if len(counts) != len(SAMPLES.split(",")) or min(counts) < least:
        raise UserError(
            f"--samples {printable(text)}: give four whole numbers, such as {SAMPLES}, {least} or more each"
        )
    return counts
