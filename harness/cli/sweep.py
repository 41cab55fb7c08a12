"""`harness sweep`: finished runs, coordinated otherwise."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from harness.cli.progress import QUIET

if TYPE_CHECKING:
    import pandas as pd

PROXY_EPISODES = 300  # a seed, as in the paper's sweeps
COLUMNS = (
    ("trigger %", "trigger_rate", 100),
    ("msgs", "messages_per_episode", 1),
    ("latency ms", "latency_proxy_ms", 1),
    ("late %", "deadline_miss_rate", 100),
)


def sweep(
    runs: list[Path] = typer.Argument(
        help="Folders of finished runs; several are drawn together.", metavar="RUN..."
    ),
    over: list[str] = typer.Option(
        [],
        help="What varies: tau, loss (%), size (vehicles), latency (ms), window (ms), consensus; repeatable. "
        "Default: the paper's panels.",
    ),
    grid: list[str] = typer.Option(
        [],
        help="Values for each --over, in order: a list 0,10,20 or from:to:step. Default: the usual ones.",
    ),
    condition: list[str] = typer.Option(
        ["6g"], help="Operating point that is varied, or a change of one: 6g:on_demand=true. Repeatable."
    ),
    seeds: str | None = typer.Option(None, help="Seeds of the channel's draws. Default: the run's."),
    latency: str = typer.Option("run", help="Inference times: the run's own, or paper (145 ms)."),
    proxy: bool = typer.Option(False, "--proxy", help="Draw the calibrated proxy beside the runs."),
    out: Path | None = typer.Option(None, help="Folder to write. Default: RUN/sweep-AXES."),
    as_json: bool = typer.Option(False, "--json", help="Print the summary as JSON."),
    quiet: bool = typer.Option(False, "--quiet", help=QUIET),
) -> None:
    """Play stored answers at other operating points. No model is asked, but for ego-prompt."""
    from harness.cli.evaluate import parse_seeds
    from harness.cli.progress import bar
    from harness.core.errors import UserError, printable, unknown
    from harness.studies.axes import axis_of
    from harness.studies.axes import grid as values_of
    from harness.studies.calibrated import Calibrated
    from harness.studies.play import Source
    from harness.studies.stored import Stored
    from harness.studies.sweep import run_sweep, settings, usual

    axes = [axis_of(name) for name in dict.fromkeys(over)]
    if len(grid) > len(axes):
        raise UserError(f"--grid: {len(grid)} given for {len(axes)} of --over; give one for each, in order")
    if latency not in ("run", "paper"):
        raise unknown("--latency", latency, ("run", "paper"))
    grids = [values_of(axis, text) for axis, text in zip(axes, [*grid, *[None] * len(axes)], strict=False)]
    conditions = list(dict.fromkeys(condition))
    with bar("grid points", 0, quiet=as_json or quiet) as progress:
        runs_read = [Stored(run, latency, progress.more, progress) for run in runs]
        panels = {
            axis.name: settings(runs_read, axis, values, conditions)
            for axis, values in zip(axes, grids, strict=True)
        } or usual(runs_read, conditions)
        draws = parse_seeds(seeds) if seeds else runs_read[0].seeds
        where = out or runs[0] / f"sweep-{'-'.join(panels)}"
        sources: list[Source] = [*runs_read, *([Calibrated(PROXY_EPISODES)] if proxy else [])]
        progress.more(len(sources) * sum(map(len, panels.values())))
        summary = run_sweep(sources, panels, draws, where, progress)
    if as_json:
        typer.echo(summary.to_json(orient="records"))
    if as_json or quiet:
        return
    tables(summary)
    typer.echo(f"wrote {printable(where / 'sweep.svg')}")


def tables(summary: "pd.DataFrame") -> None:
    """A study's success, trigger rate, messages, latency and deadline misses, a line a grid point."""
    from harness.cli.estimates import interval
    from harness.core.errors import printable
    from harness.studies.setting import CORE

    heads = f"{'success % [95 % CI]':>22}" + "".join(f"{head:>11}" for head, _, _ in COLUMNS)
    shown = ""
    for place, rows in summary.groupby(["source", "panel", "condition", "value"], sort=False, dropna=False):
        source, panel, condition, value = place
        title = f"{printable(source)}" + ("" if panel == CORE else f" · {printable(condition)} over {panel}")
        if title != shown:
            typer.echo(f"{title}\n{'condition' if panel == CORE else panel:<14}{heads}")
            shown = title
        # Over episodes, but where a seed has episodes of its own.
        of = {str(row["metric"]): row for row in sorted(rows.to_dict("records"), key=_over_episodes)}
        success = of["success_rate"]
        text = interval(success["mean"], success["ci_low"], success["ci_high"], 100)
        at = condition if panel == CORE else value if isinstance(value, str) else f"{value:g}"
        cells = "".join(f"{scale * of[metric]['mean']:>11.1f}" for _, metric, scale in COLUMNS)
        label = printable(at) if len(str(at)) < 14 else f"{printable(at)}\n"
        typer.echo(f"{label}{text:>{36 - len(label) if len(label) < 14 else 36}}{cells}")


def _over_episodes(row: dict[Any, Any]) -> bool:
    return bool(row["interval"] == "episodes")
