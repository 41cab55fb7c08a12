"""A study's folder: its figures, its tables and how it was made."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from matplotlib.figure import Figure

from harness.core.files import replacing, write_whole
from harness.report.drawing.pictures import FORMATS, save
from harness.studies.tables import as_csv, as_json_lines

if TYPE_CHECKING:
    import pandas as pd


def write(out: Path, figures: Mapping[str, Figure], tables: "Mapping[str, pd.DataFrame]") -> None:
    """Write figures as SVG, PDF and PNG, and tables as CSV and JSON Lines, each file whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    for stem, figure in figures.items():
        lay_out(figure)
        for kind in FORMATS:
            save(figure, out / f"{stem}.{kind}", kind, dpi=300)
    for stem, table in tables.items():
        for ending, written in (("csv", as_csv), ("jsonl", as_json_lines)):
            with replacing(out / f"{stem}.{ending}") as part, part.open("wb") as file:
                for rows in written(table):
                    file.write(rows)


def lay_out(figure: Figure) -> None:
    """Lay a figure out once, and not again for every format: it is half of the work."""
    if layout := figure.get_layout_engine():
        layout.execute(figure)
        figure.set_layout_engine("none")


def write_manifest(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Write how a study was made as `<kind>.json`."""
    content = {"format": f"swarmdrive-{kind}/1", **manifest}
    text = json.dumps(content, allow_nan=False)  # with an indent it takes ten times as long
    write_whole(out / f"{kind}.json", msgspec.json.format(text, indent=1) + "\n")
