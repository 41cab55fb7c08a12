"""A finished run, changed by hand."""

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

SEEDS = (0, 1)


def ends(run: Path, condition: str, by_seed: Sequence[Sequence[str]]) -> None:
    """Write down how episodes 0, 1, ... end in each seed; nothing is a success."""
    with (run / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        if row["condition"] == condition:
            row["failure"] = by_seed[int(row["seed"])][int(row["episode"])]
            row["success"] = str(row["failure"] == "")
    with (run / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def rewrite(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change each row of rows.jsonl."""
    rows = [json.loads(line) for line in (run / "rows.jsonl").read_text().splitlines()]
    for row in rows:
        change(row)
    (run / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def configure(run: Path, **values: Any) -> None:
    config = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(config | values))
