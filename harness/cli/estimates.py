"""Estimates and runs as people and as machines read them, and numbers held to their range."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from rich.console import Console

    from harness.core.statistics import Estimate
    from harness.runs.records import Manifest, Score


def as_mapping(estimate: "Estimate") -> dict[str, float | int | None]:
    """`value`, `low`, `high` and `n`; null where there is no number."""
    ends = {"value": estimate.value, "low": estimate.low, "high": estimate.high}
    return {**{k: None if math.isnan(v) else v for k, v in ends.items()}, "n": estimate.n}


def shown(estimate: "Estimate", scale: float = 100.0) -> str:
    """`89.0 [81.4, 93.7]`: a share in percent, or with another scale."""
    return interval(estimate.value, estimate.low, estimate.high, scale)


def interval(value: float | None, low: float | None, high: float | None, scale: float) -> str:
    """`value [low, high]`, one decimal; a dash for what is not known."""
    known = (math.nan if number is None else scale * number for number in (value, low, high))
    return "{} [{}, {}]".format(*("–" if math.isnan(number) else f"{number:.1f}" for number in known))


def in_range(option: str, value: int, least: int, most: int) -> None:
    """Raises UserError unless `least` <= `value` <= `most`."""
    if not least <= value <= most:
        raise UserError(f"{option} {value} is out of range; give {least} to {most}")


def tell_answers(
    console: "Console", manifest: "Manifest", figures: Mapping[tuple[str, str], "Score"]
) -> None:
    """Say below the table of a run where times come from and how answers were read.

    `figures` has its scores by condition and metric.
    """
    latency = manifest.latency
    console.print(f"latency: {latency.source} ({printable(latency.basis)})")
    if (latency.load_a_core or 0) > 1:
        console.print(
            f"timed on a busy machine ({latency.load_a_core} processes a core): "
            "let it run alone, or use --latency card or paper"
        )
    if manifest.cached_answers:
        console.print(f"{manifest.cached_answers} answers came from the cache (--no-cache asks anew)")
    if manifest.engine_errors:
        console.print(
            f"{manifest.engine_errors} answers are errors of the engine; answers.jsonl has its messages"
        )
    for role in ("ego", "helper", "merge"):
        shares = [figures.get(("all", f"{v}_rate_{role}")) for v in ("strict", "recovered", "failed")]
        if shares[0] is not None:
            values = " / ".join(f"{100 * (s.value or 0):.1f}" for s in shares if s is not None)
            console.print(f"{role} answers strict / recovered / failed: {values} % of {shares[0].n}")
