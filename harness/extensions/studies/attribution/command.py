"""`harness study attribute`: what moved a run's answers and decisions."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import echo_answer, show
from harness.core.errors import in_range, printable
from harness.core.seeds import LAST_SEED

MOST = 100_000
USUAL = "6g"


def command(
    run: Path = typer.Argument(help="Folder of a finished run of `harness eval`.", metavar="RUN"),
    sample: int = typer.Option(40, help="Number of decision points to draw at random, at most."),
    sample_seed: int = typer.Option(0, help="Seed of this draw."),
    condition: str | None = typer.Option(
        None,
        help="Condition to draw decision points from. Default: 6g, or the run's last if it has no "
        "6g.",
    ),
    dataset: options.RunsDataset = None,
    model: options.RunModel = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Show which objects and messages moved the answers.

    Each is left out of the prompt, or of the fusion, in turn.

    The run's model is asked the questions that the run has no answer for, each once. `harness
    report` then shows the result at each decision.
    """
    from harness.extensions.studies.attribution.study import attribute, attribution_study, write
    from harness.studies.replayed_run import ReplayedRun

    in_range("--sample", sample, 1, MOST)
    in_range("--sample-seed", sample_seed, 0, LAST_SEED)
    with bar("asking without", quiet=as_json or quiet, grows=True) as progress:
        cards = options.cards(model)
        stored = ReplayedRun(run, progress=progress, dataset=dataset, models=cards)
        chosen = condition or (USUAL if USUAL in stored.points else stored.run.conditions[-1])
        attribution = attribute(stored, chosen, sample, sample_seed)
    file, study = write(attribution, run), attribution_study(attribution, stored)
    if as_json:
        echo_answer(study)
    elif not quiet:
        show(study, verbose)
        typer.echo(f"wrote {printable(file)}")
