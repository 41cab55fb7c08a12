"""`harness sweep`: finished runs, coordinated otherwise."""

from pathlib import Path

import typer

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
        ...,
        help="What varies: tau, loss (%), size (vehicles), latency (ms), window (ms), consensus; repeatable.",
    ),
    grid: list[str] = typer.Option(
        [],
        help="Values for each --over, in order: a list 0,10,20 or from:to:step. Default: the usual ones.",
    ),
    condition: str = typer.Option("6g", help="Operating point that is varied."),
    seeds: str | None = typer.Option(None, help="Seeds of the channel's luck. Default: the run's."),
    out: Path | None = typer.Option(None, help="Folder to write. Default: RUN/sweep-AXES."),
    as_json: bool = typer.Option(False, "--json", help="Print the summary as JSON."),
) -> None:
    """Play stored answers at other operating points; no model is asked."""
    from harness.cli.estimates import interval
    from harness.cli.evaluate import parse_seeds
    from harness.cli.progress import bar
    from harness.errors import UserError, printable
    from harness.study.axes import axis_of
    from harness.study.axes import grid as values_of
    from harness.study.stored import Stored
    from harness.study.sweep import run_sweep, settings

    axes = [axis_of(name) for name in dict.fromkeys(over)]
    if len(grid) > len(axes):
        raise UserError(f"--grid: {len(grid)} given for {len(axes)} of --over; give one for each, in order")
    grids = [values_of(axis, text) for axis, text in zip(axes, [*grid, *[None] * len(axes)], strict=False)]
    sources = [Stored(run) for run in runs]
    panels = {
        axis.name: settings(sources, axis, values, condition)
        for axis, values in zip(axes, grids, strict=True)
    }
    luck = parse_seeds(seeds) if seeds else sources[0].seeds
    where = out or runs[0] / f"sweep-{'-'.join(panels)}"
    total = len(sources) * sum(map(len, panels.values()))
    with bar("grid points", total, quiet=as_json) as progress:
        summary = run_sweep(sources, panels, luck, where, progress)
    if as_json:
        typer.echo(summary.to_json(orient="records"))
        return
    shown = summary[summary.interval == "episodes"]
    for source, panel in dict.fromkeys(zip(shown["source"], shown["panel"], strict=True)):
        rows = shown[(shown["source"] == source) & (shown["panel"] == panel)]
        typer.echo(f"{printable(source)} · {condition} over {panel}")
        typer.echo(
            f"{panel:<14}{'success % [95 % CI]':>22}" + "".join(f"{head:>11}" for head, _, _ in COLUMNS)
        )
        for value in dict.fromkeys(rows["value"]):
            ours = rows[rows["value"] == value].to_dict("records")
            of = {str(row["metric"]): row for row in ours}
            success = of["success_rate"]
            text = interval(success["mean"], success["ci_low"], success["ci_high"], 100)
            at = value if isinstance(value, str) else f"{value:g}"
            cells = "".join(f"{scale * of[metric]['mean']:>11.1f}" for _, metric, scale in COLUMNS)
            typer.echo(f"{at:<14}{text:>22}{cells}")
    typer.echo(f"wrote {printable(where / 'sweep.svg')}")
