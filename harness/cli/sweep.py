"""`harness study sweep`: finished runs at other operating points."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish
from harness.core.errors import UserError
from harness.runs.settings import parse_seeds

PROXY = "proxy"  # the source that an extension may add


def command(
    runs: options.Runs,
    over: list[str] | None = typer.Option(
        None,
        help="Setting to vary: tau (nats), loss (0 to 1), size (vehicles), latency (ms), window "
        "(ms), "
        "consensus, content, or any other setting of an operating point by its name. Repeatable: "
        "every "
        "combination of their values is played. Default: the paper's panels.",
    ),
    grid: list[str] | None = typer.Option(
        None,
        help="Values to try: 0,10,20 or from:to:step. Give one --grid for each --over, in the same "
        "order. "
        "Default: the axis's usual values.",
    ),
    apart: bool = typer.Option(
        False,
        "--apart",
        help="Vary one setting at a time, each in a panel of its own, and combine none.",
    ),
    condition: list[str] = typer.Option(
        ["6g"],
        help="Operating point to vary, or one with changed "
        "settings: 6g:on_demand=true. Repeatable.",
    ),
    seeds: options.RunSeeds = None,
    latency: options.RunLatency = "run",
    model: options.RunModel = None,
    no_model: options.NoModel = False,
    proxy: bool = typer.Option(
        False, "--proxy", help="Also draw the calibrated proxy, which plays the paper's study."
    ),
    dataset: options.RunsDataset = None,
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: RUN/sweep-AXES, in the first run's folder."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Score a run's stored answers at other operating points.

    The model is asked only where the run has no answer.
    """
    from harness.studies.play import SOURCES, Source
    from harness.studies.replayed_run import ReplayedRun, name_apart
    from harness.studies.sweep import folder_of, panels_over, run_sweep

    if proxy and PROXY not in SOURCES:
        raise UserError(
            "--proxy: no extension that is installed has the calibrated proxy; leave it out"
        )
    with bar("grid points", quiet=as_json or quiet, grows=True) as progress:
        cards = options.cards(model)
        replayed = [
            ReplayedRun(run, latency, progress, not no_model, dataset, cards) for run in runs
        ]
        name_apart(replayed)
        panels = panels_over(
            replayed, over or (), grid or (), list(dict.fromkeys(condition)), apart
        )
        draws = parse_seeds(seeds) if seeds else replayed[0].seeds
        where = out or folder_of(runs[0], panels)
        sources: list[Source] = [*replayed, *([SOURCES[PROXY]] if proxy else [])]
        progress.more(len(sources) * sum(map(len, panels.values())))
        study = run_sweep(sources, panels, draws, where, progress, progress.say)
    finish(study, where, as_json, quiet, verbose, pictures)
