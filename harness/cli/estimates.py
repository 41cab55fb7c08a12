"""Numbers, tables and JSON as people and machines read them."""

import json
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from harness.core.statistics import Estimate

WIDTH = 80  # columns of a terminal


def echo_json(value: Any, indent: int | None = 1) -> None:
    """Print JSON."""
    typer.echo(json.dumps(value, indent=indent))


def as_mapping(estimate: "Estimate") -> dict[str, float | int | None]:
    """`value`, `low`, `high` and `n`; null where there is no number."""
    ends = {"value": estimate.value, "low": estimate.low, "high": estimate.high}
    return {**{k: None if math.isnan(v) else v for k, v in ends.items()}, "n": estimate.n}


def shown(estimate: "Estimate", scale: float = 100.0) -> str:
    """`89.0 [81.4, 93.7]`: a share in percent, or with another scale."""
    return interval(estimate.value, estimate.low, estimate.high, scale)


def interval(
    value: float | None, low: float | None, high: float | None, scale: float, decimals: int = 1
) -> str:
    """`value [low, high]`; a dash for what is not known."""
    ends = (math.nan if number is None else number for number in (value, low, high))
    numbers = ("–" if math.isnan(number) else f"{scale * number:.{decimals}f}" for number in ends)
    return "{} [{}, {}]".format(*numbers)


def console() -> "Console":
    """Plain text in 80 columns."""
    from rich.console import Console

    class Plain(Console):
        def on_broken_pipe(self) -> None:
            raise  # to `main`, and not the end of the program here

    return Plain(width=WIDTH, markup=False, highlight=False)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], tight: bool = False) -> None:
    """Print columns, the first folded and the others aligned right; `tight` ones are one space apart."""
    from rich.table import Table

    drawn = Table(box=None, width=WIDTH, pad_edge=False, padding=(0, 1, 0, 0) if tight else (0, 1))
    drawn.add_column(heads[0], overflow="fold")
    for head in heads[1:]:
        drawn.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        drawn.add_row(*row)
    console().print(drawn)
