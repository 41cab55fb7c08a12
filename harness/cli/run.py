"""What `harness eval` and `harness drive` have in common: a run's folder, its table and its JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.cli.estimates import console, interval, table
from harness.core.errors import printable

if TYPE_CHECKING:
    from harness.evaluate.evaluate import Evaluated
    from harness.evaluate.spec import Spec


@dataclass(frozen=True)
class Column:
    """A column of a run's table: the metric, and how it is written. `interval`: with its ends."""

    head: str
    metric: str
    scale: float = 1.0
    unit: str = ""
    interval: bool = False

    def cell(self, row: Any) -> str:
        """The metric's row of the summary; None if there is none."""
        if row is None or math.isnan(row.value):
            return "-"
        if self.interval:
            return interval(row.value, row.ci_low, row.ci_high, self.scale)
        return f"{row.value * self.scale:.1f}{self.unit}"


def file_name(model: str) -> str:
    """A model's name as part of a folder's."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in model).strip(".-") or "model"


def default_out(spec: "Spec", resume: bool, scenes: str | None = None) -> Path:
    """The first folder of the run's name under reports/ that is free; with `resume`, the last that is not.

    Args:
        spec: the run.
        resume: whether a run that was stopped continues.
        scenes: last part of the name; the dataset's if None.
    """
    mode = "" if spec.answer == "json" else f"-{spec.answer}"
    name = f"{file_name(spec.card.name)}-{spec.prompt.version}{mode}-{scenes or spec.dataset.name}"
    last = free = Path("reports") / name
    number = 1
    while free.exists():
        last, number = free, number + 1
        free = free.with_name(f"{name}-{number}")
    return last if resume else free


def as_mapping(done: "Evaluated") -> dict[str, Any]:
    """A finished run for machines: its folder, its manifest and the rows of its summary."""
    rows = done.summary.to_dict(orient="records")
    return {
        "run": str(done.out),
        "manifest": done.manifest,
        "summary": [{k: None if _unknown(v) else v for k, v in row.items()} for row in rows],
    }


def _unknown(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def show(
    done: "Evaluated", scenes: str, columns: Sequence[Column], notes: Sequence[str], tight: bool = False
) -> None:
    """Print a run's table, a row a condition, with what it was run on and what to know about it."""
    m = done.manifest
    rows = done.summary[done.summary.interval != "seed means"]
    figures: Mapping[Any, Any] = {(r.condition, r.metric): r for r in rows.itertuples()}
    names = [point["name"] for point in m["conditions"]]
    text = console()
    text.print(
        f"{printable(m['model']['name'], 40)} · prompt {m['prompt']['version']} · {m['answer']} · {scenes}"
    )
    table(
        ("condition", *(column.head for column in columns)),
        [(name, *(column.cell(figures.get((name, column.metric))) for column in columns)) for name in names],
        tight,
    )
    for note in (*notes, *_origins(m, figures)):
        text.print(note)


def _origins(m: Mapping[str, Any], figures: Mapping[Any, Any]) -> list[str]:
    """Where a run's times come from and how its answers were read."""
    latency = m["latency"]
    notes = [f"latency: {latency['source']} ({printable(latency['basis'])})"]
    if (latency.get("load_a_core") or 0) > 1:
        notes.append(
            f"timed on a busy machine ({latency['load_a_core']} processes a core): "
            "let it run alone, or use --latency card or paper"
        )
    if m.get("cached_answers"):
        notes.append(f"{m['cached_answers']} answers came from the cache (--no-cache asks anew)")
    if m.get("engine_errors"):
        notes.append(f"{m['engine_errors']} answers are errors of the engine; rows.jsonl has its messages")
    for role in ("ego", "helper", "merge"):
        shares = [figures.get(("all", f"{v}_rate_{role}")) for v in ("strict", "recovered", "failed")]
        if shares[0] is not None:
            values = " / ".join(f"{100 * s.value:.1f}" for s in shares if s is not None)
            notes.append(f"{role} answers strict / recovered / failed: {values} % of {shares[0].n}")
    return notes
