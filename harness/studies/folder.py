"""A study's folder: its figures, its tables and how it was made."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from matplotlib.figure import Figure

from harness.core.errors import UserError, printable
from harness.core.files import replacing, text_of, write_whole
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


def refuse_other(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Raise UserError if a folder has a finished study of this kind that was made otherwise.

    Args:
        out: the folder.
        kind: of the study.
        manifest: what its `<kind>.json` has to state; of sources, only what they are and their latency.
    """
    file = out / f"{kind}.json"
    try:
        stated = json.loads(text_of(file))
    except FileNotFoundError:
        return
    except (OSError, ValueError, RecursionError):
        stated = {}  # it is no study of this kind
    theirs = stated if isinstance(stated, dict) else {}
    now = json.loads(json.dumps(manifest))
    if other := [key for key, value in now.items() if _plain(key, theirs.get(key)) != _plain(key, value)]:
        raise UserError(
            f"{printable(out)} holds another {kind}, with other {', '.join(other)}; name another folder with "
            "--out, or delete it"
        )


def _plain(key: str, value: Any) -> Any:
    """Return a value of a study's manifest without what changes where a source moves or answers more."""
    if key != "sources" or not isinstance(value, list):
        return value
    return [
        {name: source.get(name) for name in ("name", "latency")} if isinstance(source, dict) else source
        for source in value
    ]


def write_manifest(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Write how a study was made as `<kind>.json`."""
    content = {"format": f"swarmdrive-{kind}/1", **manifest}
    text = json.dumps(content, allow_nan=False)  # with an indent it takes ten times as long
    write_whole(out / f"{kind}.json", msgspec.json.format(text, indent=1) + "\n")
