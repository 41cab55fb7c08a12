"""`harness plan`: how many layouts a difference needs."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.terminal import echo_json, echo_text, table
from harness.core.errors import UserError, in_range
from harness.core.figures import POINTS, Unit

if TYPE_CHECKING:
    from harness.report.plan import Plan, Planned

MOST = 10_000_000  # layouts
WHOLE = Unit(decimals=0)


def command(
    pilots: list[Path] | None = typer.Argument(
        None,
        help="Finished runs to plan by: one, for the gain of its conditions over single-local, or "
        "two, for B "
        "- A.",
        metavar="PILOT",
    ),
    detect: float = typer.Option(5.0, help="Difference of success to find, in points: 0.1 to 99."),
    power: float = typer.Option(80.0, help="Chance to find it, in percent: 50 to 99."),
    layouts: int | None = typer.Option(
        None,
        help="Also say which difference so many layouts find. Default: as many as the pilots have.",
    ),
    rate: float | None = typer.Option(
        None, help="Instead of pilots: the success that is expected, in percent."
    ),
    correlation: float | None = typer.Option(
        None,
        help="With --rate: correlation of both outcomes over "
        "layouts, 0 to 1. Default: 0, as if the "
        "layouts "
        "were not the same.",
    ),
    as_json: options.Json = False,
) -> None:
    """Say how many layouts, requests and minutes a difference takes.

    A difference is found if its 95 % interval leaves out 0.
    """
    from harness.report.plan import as_mapping, from_pilots, from_rate

    in_range("--detect", detect, 0.1, 99)
    in_range("--power", power, 50, 99)
    if layouts is not None:
        in_range("--layouts", layouts, 2, MOST)
    if bool(pilots) == (rate is not None):
        raise UserError(
            "a plan needs one or two finished runs as pilots, or --rate with the success that you "
            "expect, in percent; give one of both"
        )
    if correlation is not None:
        if rate is None:
            raise UserError("--correlation goes with --rate; pilots show their own; leave it out")
        in_range("--correlation", correlation, 0, 1)
    if rate is not None:
        in_range("--rate", rate, 0, 100)
        plan = from_rate(rate / 100, correlation or 0.0, detect / 100, power / 100, layouts)
    else:
        if pilots and len(pilots) > 2:
            raise UserError(f"{len(pilots)} pilots; give one run, or the two that are compared")
        plan = from_pilots(pilots or [], detect / 100, power / 100, layouts)
    if as_json:
        echo_json(as_mapping(plan, detect / 100, power / 100))
        return
    _show(plan, detect, power)


def _show(plan: "Plan", detect: float, power: float) -> None:
    typer.echo(plan.difference)
    finds = [f"{plan.layouts} layouts find"] if plan.layouts else []
    costs = ["requests", "tokens", "minutes"] if plan.rows[0].cost else []
    heads = ("condition", "layouts [95 % CI]", *costs, *finds)

    def cells(row: "Planned") -> list[str]:
        needed = row.layouts
        layouts = WHOLE.interval(needed.value, needed.low, needed.high)
        if not needed.n:
            layouts = WHOLE.number(needed.value)
        cost = [WHOLE.number(value) for value in vars(row.cost).values()] if row.cost else []
        return [
            row.condition or "stated rate",
            layouts,
            *cost,
            *([POINTS.text(row.finds)] if finds else []),
        ]

    table(heads, [cells(row) for row in plan.rows])
    echo_text(
        f"layouts: so many find a difference of {detect:g} points with a chance of {power:g} %, by "
        f"a 95 % interval, if {plan.basis}"
        + ("; [..]: over other pilots of as many layouts" if costs else "")
    )
    if costs:
        echo_text(
            "requests, tokens, minutes: of all runs and conditions of the pilots, at their number "
            "a layout; minutes one answer after the other, known where pilots asked with "
            "--batch-size 1"
        )
    else:
        echo_text("requests and tokens: `harness eval --dry-run` counts those of a dataset")
