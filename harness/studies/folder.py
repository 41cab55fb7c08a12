"""A study's folder: its figures, its tables and how it was made."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from harness.core.files import replacing, write_whole
from harness.report.drawing.pictures import FORMATS, save

if TYPE_CHECKING:
    import pandas as pd

ROWS = 100_000  # that are text in memory at a time


def write(out: Path, figures: Mapping[str, Figure], tables: "Mapping[str, pd.DataFrame]") -> None:
    """Write figures as SVG, PDF and PNG, and tables as CSV and JSON Lines, each file whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    for stem, figure in figures.items():
        # Where things go is laid out once and not for every format: it is half of the work.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for kind in FORMATS:
            save(figure, out / f"{stem}.{kind}", kind, dpi=300)
    for stem, table in tables.items():
        with replacing(out / f"{stem}.csv") as part:
            table.to_csv(part, index=False)
        with replacing(out / f"{stem}.jsonl") as part, part.open("w", encoding="utf-8") as file:
            for first in range(0, len(table), ROWS):
                file.write(table[first : first + ROWS].to_json(orient="records", lines=True))


def write_manifest(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Write how a study was made as `<kind>.json`."""
    content = {"format": f"swarmdrive-{kind}/1", **manifest}
    write_whole(out / f"{kind}.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
