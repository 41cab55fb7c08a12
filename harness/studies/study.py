"""A study: what was computed, in tables, figures and sentences,
and one writer of its folder and page.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from markupsafe import Markup

from harness.core import extras
from harness.core.errors import UserError, printable
from harness.core.extensions import studies
from harness.core.figures import PERCENT
from harness.core.files import appending, bytes_of, neutral, replacing, text_of, write_whole
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate
from harness.report.document import Section, Table, document, strong
from harness.report.library import on_dark_too, picture

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from harness.report.drawing.pictures import Format

DRAWN: "tuple[Format, ...]" = ("svg", "pdf", "png")  # the kinds of picture in a study's folder
WIDEST_REM, REM_PER_INCH = 66, 10.5
SOURCE = ("name", "latency")  # of a source, what makes a study another one


@dataclass(frozen=True)
class Study:
    """A finished study."""

    kind: str  # names its manifest, `<kind>.json`
    title: str  # what was run
    headline: Sequence[str]  # the outcome in sentences, with n and intervals
    # how it was made: n, what the intervals are over, and what the outcome is conditional on
    about: Sequence[str]
    tables: Sequence[Table]  # for the page and the terminal
    # the tables that are written as CSV and JSON Lines, by file name
    data: "Mapping[str, pd.DataFrame]"
    manifest: Mapping[str, Any]  # what it was made of
    answer: Any  # what `--json` prints, a data frame or plain values
    # draws them by file name, where matplotlib is installed
    figures: "Callable[[], Mapping[str, Figure]]" = dict
    caveats: Sequence[str] = ()  # what a reader must know first
    more: Markup = field(default_factory=Markup)  # what else the page shows, below the tables


def p_cell(p: float | None) -> str:
    """Return a p-value as a cell, bold where it is at most `LEVEL`; a dash where there is none."""
    if p is None:
        return "–"
    return strong("< 0.001" if p < 0.001 else f"{p:.3f}", p <= LEVEL)


def ends(e: Estimate) -> dict[str, Any]:
    """Return an estimate, its 95 % interval and its n as columns of a row."""
    return {"value": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n}


def corrected(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p-values corrected together by Holm's method; None stays None."""
    known = iter(holm([p for p in p_values if p is not None]))
    return [None if p is None else next(known) for p in p_values]


def percent(row: Any, value: str, low: str, high: str) -> str:
    """Return columns of a row, a share with its interval, as `89.0 [81.4, 93.7]` percent."""
    return PERCENT.interval(row[value], row[low], row[high])


def write_study(study: Study, out: Path) -> Path:
    """Write figures, tables, the page, and last the manifest, each file whole; return the page."""
    refuse_taken(out, study.kind)
    out.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(study, out) if undrawn(study) is None else {}
    for stem, table in study.data.items():
        write_table(table, out / stem)
    section = Section(
        study.title,
        study.headline,
        study.about,
        study.tables,
        caveats=study.caveats,
        pictures=pictures,
        more=study.more,
    )
    write_whole(out / "index.html", document([section]))
    manifest = {"format": f"swarmdrive-{study.kind}/1", **study.manifest}
    text = msgspec.json.format(json.dumps(manifest, allow_nan=False), indent=1)
    write_whole(out / f"{study.kind}.json", text + "\n")
    return out / "index.html"


def undrawn(study: Study) -> UserError | None:
    """Return what keeps the figures of a study from being drawn:
    a package that is not installed.
    """
    if study.figures is dict:
        return None
    try:
        extras.need("drawing figures", "matplotlib")
    except UserError as error:
        return error
    return None


def _pictures(study: Study, out: Path) -> dict[str, tuple[str, int]]:
    """Draw the figures into a folder; return each as an address, with its width in rem."""
    from harness.report.drawing.pictures import save

    pictures = {}
    for stem, figure in study.figures().items():
        for kind in DRAWN:
            save(figure, out / f"{stem}.{kind}", kind, dpi=300)
        width_rem = round(min(WIDEST_REM, REM_PER_INCH * figure.get_size_inches()[0]))
        pictures[stem] = picture(on_dark_too(bytes_of(out / f"{stem}.svg", "picture"))), width_rem
    return pictures


def write_table(table: "pd.DataFrame", path: Path) -> None:
    """Write a table as CSV, whose texts no spreadsheet takes for formulas, and as JSON Lines."""
    safe = table.copy(deep=False)
    texts = table.select_dtypes(exclude=["number", "bool"])
    for name, column in texts.items():
        # Few texts are in many rows: one check of each is cheaper than `neutral` of every cell.
        if any(neutral(text) is not text for text in column.unique()):
            safe[name] = column.astype(object).map(neutral)
    with replacing(path.with_name(f"{path.name}.csv")) as part:
        safe.to_csv(part, index=False, lineterminator="\n", compression=None)
    with replacing(path.with_name(f"{path.name}.jsonl")) as part:
        table.to_json(part, orient="records", lines=True, compression=None)


def refuse_taken(out: Path, kind: str) -> None:
    """Raise UserError if a folder has a finished run, or a finished study of another kind."""
    for name in ("run", "suite", *studies()):
        if name != kind and (out / f"{name}.json").exists():
            raise UserError(
                f"--out {printable(out)} holds something else, as its {name}.json says; name "
                "another folder"
            )


def refuse_other(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Raise UserError if a folder has a run, another kind of study,
    or one of this kind made otherwise.

    `manifest` is what its `<kind>.json` has to state; of sources, only what they are and their
    latency. What an older study does not state is not held against it.
    """
    refuse_taken(out, kind)
    try:
        stated = json.loads(text_of(out / f"{kind}.json"))
    except FileNotFoundError:
        return
    except (OSError, ValueError, RecursionError):
        stated = None
    new = json.loads(json.dumps(manifest))
    old = {**new, **stated} if stated and isinstance(stated, dict) else {}  # else it is no study
    differing = []
    for key, value in new.items():
        if _lasting(key, old.get(key)) != _lasting(key, value):
            differing.append(key)
    if differing:
        raise UserError(
            f"{printable(out)} holds another {kind}, with other {', '.join(differing)}; name "
            "another folder with --out, or delete it"
        )


class Cells:
    """Finished parts of a study in a file, a line each,
    so that the same command continues a killed one.
    """

    def __init__(self, path: Path, depends_on: str) -> None:
        """Read a file. Torn lines and those of another digest of all that decides a part do not
        count.
        """
        self._path, self._of = path, depends_on
        data = bytes_of(path, "rows") if path.is_file() else b""
        self._torn = bool(data) and not data.endswith(b"\n")
        self._cells = dict(self._read(data))

    def _read(self, data: bytes) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
        for line in data.splitlines():
            try:
                kept = json.loads(line)
                if kept["of"] == self._of:
                    yield tuple(kept["key"]), {k: _array(v) for k, v in kept["cell"].items()}
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue

    def __contains__(self, key: Sequence[Any]) -> bool:
        return tuple(key) in self._cells

    def part(
        self, key: Sequence[Any], compute: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return a part as it was kept, to the last bit, or else compute it and keep it.

        Its values are plain, or arrays of two axes.
        """
        if (kept := self._cells.get(tuple(key))) is not None:
            return kept
        values = compute()
        line = json.dumps({"of": self._of, "key": key, "cell": values}, default=np.ndarray.tolist)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with appending(self._path) as file:
            file.write(b"\n" * self._torn + line.encode() + b"\n")
        self._torn = False
        return values


def _array(value: Any) -> Any:
    nested = isinstance(value, list) and value and isinstance(value[0], list)
    return np.array(value, dtype=float) if nested else value


def _lasting(key: str, value: Any) -> Any:
    """Return a value of a manifest without what changes where a source moves or answers more."""
    if key != "sources" or not isinstance(value, list):
        return value
    sources = []
    for source in value:
        if isinstance(source, dict):
            source = {name: source.get(name) for name in SOURCE}
        sources.append(source)
    return sources
