"""`harness study sweep`: finished runs at other operating points."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core.errors import UserError, printable, unknown

if TYPE_CHECKING:
    import pandas as pd

PROXY_EPISODES = 300  # a seed, as in the paper's sweeps
LABEL = 14  # characters of a grid point's name that leave its row on one line


def command(
    runs: options.Runs,
    over: list[str] | None = typer.Option(
        None,
        help="Setting to vary: tau (nats), loss (0 to 1), size (vehicles), latency (ms), window (ms), "
        "consensus, or any other setting of an operating point by its name. Repeatable. Default: the "
        "paper's panels.",
    ),
    grid: list[str] | None = typer.Option(
        None,
        help="Values to try: 0,10,20 or from:to:step. Give one --grid for each --over, in the same order. "
        "Default: the axis's usual values.",
    ),
    condition: list[str] = typer.Option(
        ["6g"],
        help="Operating point to vary, or one with changed settings: 6g:on_demand=true. Repeatable.",
    ),
    seeds: str | None = typer.Option(None, help="Channel seeds, such as 0:5 or 3,7,9. Default: the run's."),
    latency: str = typer.Option(
        "run", help="Inference time of one answer: run (as in the run) or paper (145 ms)."
    ),
    model: options.RunModel = None,
    no_model: bool = typer.Option(
        False,
        "--no-model",
        help="Never ask the model: leave out episodes that reach a decision point without a stored answer.",
    ),
    proxy: bool = typer.Option(
        False, "--proxy", help="Also draw the calibrated proxy, which plays the paper's study."
    ),
    dataset: options.RunsDataset = None,
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: RUN/sweep-AXES, in the first run's folder."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Score a run's stored answers at other operating points.

    The model is asked only where the run has no answer.
    """
    from harness.studies.axes import axis_of
    from harness.studies.axes import grid as values_of
    from harness.studies.calibrated import Calibrated
    from harness.studies.play import Source
    from harness.studies.stored import Stored
    from harness.studies.sweep import run_sweep, settings, usual

    axes = [axis_of(name) for name in dict.fromkeys(over or ())]
    given: list[str | None] = [*(grid or ())]
    if len(given) > len(axes):
        raise UserError(
            f"--grid: {len(given)} given for {len(axes)} of --over; give one for each --over, in the same "
            "order"
        )
    if latency not in ("run", "paper"):
        raise unknown("--latency", latency, ("run", "paper"))
    grids = [values_of(axis, text) for axis, text in zip(axes, [*given, *[None] * len(axes)], strict=False)]
    conditions, silent = list(dict.fromkeys(condition)), as_json or quiet
    with bar("grid points", quiet=silent, grows=True) as progress:
        own = options.cards(model)
        stored = [
            Stored(run, latency, progress.more, progress, not no_model, dataset, own, progress.say)
            for run in runs
        ]
        panels = {
            axis.name: settings(stored, axis, values, conditions)
            for axis, values in zip(axes, grids, strict=True)
        } or usual(stored, conditions)
        draws = options.parse_seeds(seeds) if seeds else stored[0].seeds
        where = out or runs[0] / f"sweep-{'-'.join(panels)}"
        sources: list[Source] = [*stored, *([Calibrated(PROXY_EPISODES)] if proxy else [])]
        progress.more(len(sources) * sum(map(len, panels.values())))
        summary = run_sweep(sources, panels, draws, where, progress)
    if as_json:
        typer.echo(summary.to_json(orient="records"))
    if not silent:
        show_tables(summary)
        for source in stored:
            if source.lost:
                typer.echo(source.lost)
            if source.left_out:
                typer.echo(source.leaves_out)
        typer.echo(f"wrote {printable(where / 'index.html')}")


def show_tables(summary: "pd.DataFrame") -> None:
    """Print a study's success, trigger rate, messages, latency and deadline misses, a line a grid point."""
    from harness.studies.sweep import tables

    for title, rows in tables(summary).items():
        heads = f"{'success % [95 % CI]':>22}" + "".join(f"{head:>11}" for head in rows[0].others)
        typer.echo(f"{printable(title)}\n{rows[0].axis:<{LABEL}}{heads}")
        for row in rows:
            at = printable(row.at)
            label = f"{at:<{LABEL}}" if len(row.at) < LABEL else f"{at}\n{'':<{LABEL}}"
            typer.echo(f"{label}{row.success:>22}" + "".join(f"{text:>11}" for text in row.others.values()))
