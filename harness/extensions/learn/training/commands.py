"""`harness model distill` trains a small language model;
`harness prompt examples` shows answers to any.
"""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.prompt import Version
from harness.cli.scenario import ready_to_drive
from harness.core import extras, resources, work
from harness.core.errors import UserError, in_range, printable, unknown
from harness.core.files import write_whole
from harness.core.seeds import FIRST, LAST_SEED, purpose, seeds_text

if TYPE_CHECKING:
    from harness.backends.card import Card
    from harness.world.scenario import Scenario

SAMPLES = "60000,160000,30000,50000"
BATCH = 16
RANK = 16
RATES = {True: 1e-3, False: 1e-4}  # with an adapter, and without
MOST = 512  # of a rank
MOST_THREADS = 1024
DTYPES = ("float32", "bfloat16")
REPORT = 0.3
OBJECTIVES = ("imitation", "values")


def distill(
    scenario: list[str] = typer.Argument(
        help="Scenarios to learn; `harness dataset scenario list` shows them."
    ),
    out: Path = typer.Option(..., help="Folder to make; its name becomes the model's name."),
    prompt: list[str] = typer.Option(
        ["v2", "v4"],
        help="Prompt version to learn; it is used in the scenarios that it fits. Repeatable.",
    ),
    base: str | None = typer.Option(
        None,
        help="Model to begin as, by card, folder, .gguf file or hub id. Default: random weights.",
    ),
    lora: bool = typer.Option(
        False,
        "--lora",
        help="Train an adapter of a published base and keep its weights as they are.",
    ),
    rank: int | None = typer.Option(None, help=f"Rank of the adapter. Default: {RANK}."),
    rate: float | None = typer.Option(
        None,
        help=f"Learning rate for a published base. Default: {RATES[False]:g}; {RATES[True]:g} with "
        "--lora.",
    ),
    dtype: str = typer.Option(
        DTYPES[0], help="What layers of a published base compute in: float32 or bfloat16."
    ),
    report: float | None = typer.Option(
        None,
        help=f"Weight of the words behind a letter, for a published base. Default: {REPORT:g}.",
    ),
    objective: str = typer.Option(
        OBJECTIVES[0], help="What letters learn: imitation of soft labels, or values of actions."
    ),
    layouts: int = typer.Option(240, help="Number of layouts of each scenario."),
    first_seed: int = typer.Option(
        FIRST["train"], help="Layout seed of the first layout; train seeds are 100000 to 199999."
    ),
    samples: str = typer.Option(
        SAMPLES,
        help="Sequences of the stages excerpts, alone, messages and answers; 0 leaves one out.",
    ),
    seed: int = typer.Option(
        0, help="Seed of the initial weights and of the order of the sequences."
    ),
    batch: int = typer.Option(BATCH, help="Sequences per training step."),
    device: str = typer.Option("cpu", help="Where to train: cpu, cuda or cuda:N."),
    threads: int | None = typer.Option(
        None, help="Number of CPU threads. Default: PyTorch's choice."
    ),
    workers: options.Workers = "2",
) -> None:
    """Train a small Qwen3, or a published model, in some scenarios.

    With an image prompt the small one is a Qwen3-VL, which takes pictures and text.
    If the training is stopped, the same command continues it.
    """
    from harness.dataset import rebuilt
    from harness.prompts import versions as prompts

    extras.need("harness model distill", "torch", "transformers", "highway_env")
    if batch < 1:
        raise UserError(f"--batch {batch}: give 1 or more")
    if threads is not None:
        in_range("--threads", threads, 1, MOST_THREADS)
    in_range("--seed", seed, 0, LAST_SEED)
    _check_out(out)
    if objective not in OBJECTIVES:
        raise unknown("--objective", objective, OBJECTIVES)
    start, adapt = _base(base, lora, rank, rate, dtype, report)
    versions = [prompts.load(version) for version in dict.fromkeys(prompt)]
    driven = [
        ready_to_drive(name, layouts, first_seed, "--layouts") for name in dict.fromkeys(scenario)
    ]
    if purpose(first_seed, layouts) != "train":
        raise UserError(
            f"--first-seed {first_seed}: {seeds_text(first_seed, layouts)}; a model learns from "
            f"train seeds alone, {FIRST['train']} to {FIRST['report'] - 1}"
        )
    for each in driven:
        rebuilt.refuse_drawn(each, range(first_seed, first_seed + layouts))
    learnt = {}
    for each in driven:
        learnt[each] = tuple(v for v in versions if not prompts.unfit(v, each))
        if not learnt[each]:
            raise UserError(
                f"--prompt {printable(' '.join(prompt))}: none is for {each.name}; give "
                f"{each.prompt}, or one of your own"
            )
    # A stage has a batch at least, and that of messages takes a scene for four sequences of each
    # prompt.
    pairs = sum(len(of_scenario) for of_scenario in learnt.values())
    counts = _counts(samples, max(batch, 4 * pairs))

    from harness.backends.card import Card
    from harness.backends.transformers.engine import choose_device
    from harness.extensions.learn.training.distill import Curriculum
    from harness.extensions.learn.training.distill import distill as run
    from harness.extensions.learn.training.published import Adapt
    from harness.extensions.learn.training.train import STAGES, Objective, Plan
    from harness.world import scenarios

    how = Adapt(*adapt) if isinstance(start, Card) else None
    samples_of = dict(zip(STAGES, counts, strict=True))
    plan = Plan(
        samples_of, batch=batch, seed=seed, adapt=how, objective=cast("Objective", objective)
    )
    begun_s = time.monotonic()
    drawn = layouts * len(learnt)
    for each in learnt:
        typer.echo(printable(scenarios.title(each)))
        _say_caveat(each)
    with bar("drawing layouts", drawn) as progress:

        def show(stage: str, seen: int, loss: float, *watched: float) -> None:
            progress.label = f"{stage} loss {loss:.3f}"
            if watched:
                progress.label += f", held-out KL {watched[0]:.3f}, value {watched[1]:.3f}"
            progress.more(drawn + sum(counts) - progress.total)
            progress(drawn + sum(counts[: STAGES.index(stage)]) + seen - progress.done)

        facts = run(
            Curriculum(learnt, layouts, first_seed, start),
            plan,
            out,
            progress,
            show,
            choose_device(device),
            threads,
            options.workers_of(workers),
        )
    for apart in facts["held_out"]:
        typer.echo(
            f"{apart['scenario']}: held-out KL {apart['kl_nats']:.3f} nats (mean label "
            f"{apart['kl_of_the_mean_nats']:.3f}), value {apart['value']:.3f} "
            f"({apart['value_of_the_mean']:.3f}), n = {apart['questions']}"
        )
        others = (f"{name} {worth:.3f}" for name, worth in apart["references"].items())
        typer.echo(f"  who needs no model: value {', '.join(others)}")
    typer.echo(
        f"wrote {printable(out)}: {facts['parameters']:,} parameters, "
        f"{time.monotonic() - begun_s:.0f} s"
    )


def examples(
    version: Version,
    scenario: str = typer.Option(..., help="Scenario to take the examples from."),
    count: int = typer.Option(
        2, help="Number of examples for each role, each from a layout of its own."
    ),
    first_seed: int = typer.Option(
        FIRST["train"], help="Layout seed of the first example; train seeds are 100000 to 199999."
    ),
) -> None:
    """Add examples to a draft: earlier turns of the chat.

    They are answered as the decision trees show to be right.
    """
    from harness.prompts import versions as prompts
    from harness.prompts.examples import EXAMPLES, text_of

    extras.need("harness prompt examples", "highway_env")
    draft, played = prompts.load(version), ready_to_drive(scenario, count, first_seed, "--count")
    file = resources.find("prompts", version) / EXAMPLES
    if draft.released:
        raise UserError(
            f"prompt {version} is released; copy it to a new version to give it examples"
        )
    if draft.examples:
        raise UserError(f"{printable(file)} is there already; delete it to draw others")
    if reason := prompts.unfit(draft, played):
        raise UserError(f"prompt {version} {reason}; give another --scenario, or another version")
    from harness.extensions.learn.training import prompt_examples
    from harness.world import scenarios

    with bar("drawing layouts", count) as progress:
        drawn = prompt_examples.examples(draft, played, count, first_seed, progress)
    write_whole(file, text_of(drawn))
    typer.echo(f"wrote {printable(file)} of {printable(scenarios.title(played))}: {drawn}")
    _say_caveat(played)


def _say_caveat(scenario: "Scenario") -> None:
    if scenario.caveat:
        typer.echo(scenario.caveat)


def _check_out(out: Path) -> None:
    """Raise UserError where a model cannot be made: a file, or a folder of a card's name."""
    name = out.absolute().name
    if (resources.folder("models") / f"{name}.toml").is_file():
        raise UserError(
            f"--out {printable(out)}: its name is the model's, and {name} ships; give another"
        )
    if not out.is_dir():
        work.start_of(out, work.WorkStart)


def _counts(text: str, least: int) -> list[int]:
    """Return four numbers of sequences, none below `least`."""
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if (
        len(counts) != len(SAMPLES.split(","))
        or not any(counts)
        or any(0 != n < least for n in counts)
    ):
        raise UserError(
            f"--samples {printable(text)}: give four whole numbers, such as {SAMPLES}, {least} or "
            "more each, or 0 to leave a stage out"
        )
    return counts


def _base(
    text: str | None,
    lora: bool,
    rank: int | None,
    rate: float | None,
    dtype: str,
    report: float | None,
) -> "tuple[Path | Card | None, tuple[int | None, float, Any, float]]":
    """Return what a model begins as, and how a published one is changed, in the order of `Adapt`.

    That is the folder of a model of texts that was distilled here, or the card of a published one.
    """
    from harness.backends import cards

    if rank is not None and not lora:
        raise UserError(f"--rank {rank} goes with --lora, which trains an adapter")
    for flag, value in (("--rank", rank), ("--rate", rate)):
        if value is not None and not 0 < value <= MOST:
            raise UserError(f"{flag} {value:g}: give more than 0 and at most {MOST}")
    if dtype not in DTYPES:
        raise unknown("--dtype", dtype, DTYPES)
    if report is not None and not 0 <= report <= MOST:
        raise UserError(f"--report {report:g}: give 0 to {MOST}")
    adapt = (
        rank or RANK if lora else None,
        rate or RATES[lora],
        dtype,
        REPORT if report is None else report,
    )
    folder = Path(text or "")
    ours = (cards.TAUGHT, "model.safetensors", "tokenizer.json")
    if text and not lora and all((folder / name).is_file() for name in ours):
        start: Path | None = folder
    elif text:
        return _published(text), adapt
    else:
        start = None
    if lora or rate or dtype != DTYPES[0] or report is not None:
        raise UserError("--lora, --rate, --dtype and --report go with --base, a published model")
    return start, adapt


def _published(text: str) -> "Card":
    """Return the card of a model whose weights can be taught.
    Raises UserError if there are none.
    """
    from harness.backends import cards

    engine = cards.resolve(text).engine
    try:
        return cards.resolve(text, "transformers")
    except UserError:
        raise UserError(
            f"--base {printable(text)}: it runs on {engine} alone and has no weights that can be "
            "taught; give a model that runs on transformers, such as smollm2-135m (`harness model "
            "list`)"
        ) from None
