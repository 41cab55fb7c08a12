"""A study: what was computed, in tables, figures and sentences,
and one writer of its folder and page.
"""

import csv
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np
from markupsafe import Markup

from harness.core import extras
from harness.core.errors import UserError, printable, sayable_path
from harness.core.extensions import studies
from harness.core.figures import PERCENT
from harness.core.files import (
    appending,
    bytes_of,
    is_there,
    neutral,
    replacing,
    text_of,
    write_whole,
)
from harness.core.multiplicity import LEVEL, holm
from harness.core.seals import seal
from harness.core.statistics import Estimate
from harness.report.document import Chart, Section, Table, document, strong
from harness.studies.figures import charts
from harness.studies.figures.described import Draws

if TYPE_CHECKING:
    import pandas as pd

    from harness.report.drawing.pictures import Format

DRAWN: "tuple[Format, ...]" = ("svg", "pdf", "png")  # the kinds of picture in a study's folder
EMPTY = '""'
ROWS_AT_ONCE = 1 << 14  # of a table that is written as JSON
SOURCE = ("name", "latency", "dataset_sha256")  # of a source, what makes a study another one


@dataclass(frozen=True)
class Study:
    """Hold a finished study: its texts, tables, figures, data and manifest.

    A study plays answers at many operating points, and sums up. Its manifest is a JSON file that
    says what it was made of.

    `kind` names its manifest's file; `headline` is the outcome in sentences, `about` says how it
    was made, `caveats` what a reader must know first, and `verdicts` what it passed. `tables` are
    to be shown, and `data` to be written, by file name. `answer` is what --json prints. `figures`
    takes what draws, for the page or for files, and returns the figures by file name; None for
    none. `more` is HTML that its page shows below the tables.
    """

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
    # takes what draws, for the page or for files, and returns them by file name; None for none
    figures: Callable[[Draws[Any]], Mapping[str, Any]] | None = None
    caveats: Sequence[str] = ()  # what a reader must know first
    verdicts: Sequence[str] = ()  # of the tests that it was to pass, a sentence each
    more: Markup = field(default_factory=Markup)  # what else the page shows, below the tables


def p_cell(p: float | None) -> str:
    """Return a p-value as the text of a cell, bold if it is at most `LEVEL`; a dash for None."""
    if p is None:
        return "–"
    return strong("< 0.001" if p < 0.001 else f"{p:.3f}", p <= LEVEL)


def ends(e: Estimate) -> dict[str, Any]:
    """Return an estimate as cells of a table's row: `value`, `ci_low`, `ci_high` and `n`.

    The `ci_` ones are the ends of its confidence interval.
    """
    return {"value": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n}


def corrected(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p-values corrected together by Holm's method, in their order; None stays None."""
    corrected_values = iter(holm([p for p in p_values if p is not None]))
    return [None if p is None else next(corrected_values) for p in p_values]


def percent(row: Any, value: str, low: str, high: str) -> str:
    """Return a share with its interval in percent, `89.0 [81.4, 93.7]`, from columns of a row.

    `row` is a row of a data frame (or a mapping), with shares from 0 to 1; `value`, `low` and
    `high` are the columns' names.
    """
    return PERCENT.interval(row[value], row[low], row[high])


def write_study(study: Study, out: Path, draws: bool = True) -> Path:
    """Write a study's figures, tables, page and manifest into a folder; return the page's path.

    The page draws its charts in a browser. Figures are also written as files if `draws`, unless
    matplotlib, whose import alone takes longer than many a study, is not installed. Raises
    UserError if the folder holds something else.
    """
    refuse_taken(out, study.kind)
    out.mkdir(parents=True, exist_ok=True)
    if draws and undrawn(study) is None:
        _draw(study, out)
    for stem, table in study.data.items():
        write_table(table, out / stem)
    section = Section(
        study.title,
        [*study.headline, *study.verdicts],
        study.about,
        study.tables,
        caveats=study.caveats,
        charts=_charts(study),
        more=study.more,
    )
    write_whole(out / "index.html", document([section]))
    manifest = {
        "format": f"swarmdrive-{study.kind}/1",
        **study.manifest,
        "caveats": list(study.caveats),
    }
    text = msgspec.json.format(json.dumps(manifest, allow_nan=False), indent=1)
    write_whole(out / f"{study.kind}.json", text + "\n")
    return out / "index.html"


def undrawn(study: Study) -> UserError | None:
    """Return the error for a study whose figures cannot be written as files; None if they can be.

    Matplotlib, which draws them, is not installed then.
    """
    if study.figures is None:
        return None
    try:
        extras.need("drawing figures", "matplotlib")
    except UserError as error:
        return error
    return None


def _draw(study: Study, out: Path) -> None:
    """Draw the figures into a folder, each in all formats."""
    if study.figures is None:
        return
    from harness.report.drawing.pictures import save
    from harness.studies.figures import pictures

    for stem, figure in study.figures(pictures).items():
        for kind in DRAWN:
            save(figure, out / f"{stem}.{kind}", kind, dpi=300)


def _charts(study: Study) -> dict[str, Chart]:
    """Return the charts of the study's page by name, a figure's panels one after the other."""
    if study.figures is None:
        return {}
    named = {}
    for stem, panels in study.figures(charts).items():
        for n, chart in enumerate(panels, 1):
            named[stem if len(panels) == 1 else f"{stem}-{n}"] = chart
    return named


def write_table(table: "pd.DataFrame", path: Path) -> None:
    """Write a table as `path`.csv and `path`.jsonl.

    In the CSV file, texts that a spreadsheet takes for formulas get an apostrophe before them.
    """
    csv_path, json_path = (path.with_name(f"{path.name}.{kind}") for kind in ("csv", "jsonl"))
    with (
        replacing(csv_path) as csv_part,
        replacing(json_path) as json_part,
        csv_part.open("w", encoding="utf-8", newline="") as csv_file,
        json_part.open("w", encoding="utf-8") as json_file,
    ):
        csv.writer(csv_file, lineterminator="\n").writerow(table.columns)
        # Of all rows at once, the text would take more memory than what it was made of.
        for start in range(0, max(len(table), 1), ROWS_AT_ONCE):
            rows = table[start : start + ROWS_AT_ONCE]
            columns = [_texts(rows[name]) for name in rows]
            csv_rows = zip(*(of_csv for of_csv, _ in columns), strict=True)
            # An empty cell that is alone in its row is quoted, or the row would be none.
            csv_file.writelines(f"{','.join(cells) or EMPTY}\n" for cells in csv_rows)
            json_rows = zip(*(of_json for _, of_json in columns), strict=True)
            json_file.writelines(f"{{{','.join(cells)}}}\n" for cells in json_rows)


def _texts(column: "pd.Series[Any]") -> tuple[list[str], list[str]]:
    """Return a column's values as cells of CSV, and as members of JSON objects.

    Each different value is written once: to write them all takes twice the time.
    """
    import pandas as pd

    codes, values = np.arange(len(column)), column
    if column.dtype == float:
        codes, bits = pd.factorize(column.to_numpy().view(np.int64))  # 0.0 and -0.0 differ
        values = pd.Series(bits.view(float), name=column.name)
    elif column.dtype != object:  # in which 1, 1.0 and True would be one
        codes, different = pd.factorize(column, use_na_sentinel=False)
        values = pd.Series(different, name=column.name)
    objects = values.to_frame().to_json(orient="records", lines=True).splitlines()
    if values.hasnans:
        values = values.astype(object).where(values.notna(), None)
    lines = list[str]()
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\n")
    # beside another cell, with which an empty one is not quoted
    writer.writerows((neutral(value), 0) for value in values.tolist())
    of_csv = np.array([line.removesuffix(",0\n") for line in lines], dtype=object)
    of_json = np.array([line[1:-1] for line in objects], dtype=object)
    return of_csv[codes].tolist(), of_json[codes].tolist()


def refuse_taken(out: Path, kind: str) -> None:
    """Raise UserError if a folder holds a finished run, or a finished study of another kind.

    `kind` is the kind of study that is to be written to `out`, such as `sweep`. A name that no
    terminal can show is refused, too.
    """
    sayable_path("--out", out)
    for name in ("run", "suite", *studies()):
        if name != kind and (out / f"{name}.json").exists():
            raise UserError(
                f"--out {printable(out)} holds something else, as its {name}.json says; name "
                "another folder"
            )


def refuse_other(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Raise UserError unless a study may go on in a folder: its own kind and settings, or none.

    `kind` is the kind of study that is to be written to `out`, and `manifest` what its
    `<kind>.json` must state; of the runs that it scores, only name and latency count. Keys that the
    study there does not state, since its version of the program had none, are ignored. A run there
    is refused, too.
    """
    refuse_taken(out, kind)
    try:
        record = json.loads(text_of(out / f"{kind}.json"))
    except FileNotFoundError:
        return
    except (OSError, ValueError, RecursionError):
        record = None
    new = json.loads(json.dumps(manifest))
    old = {**new, **record} if record and isinstance(record, dict) else {}  # else it is no study
    differing = []
    for key, value in new.items():
        if _lasting(key, old.get(key)) != _lasting(key, value):
            differing.append(key)
    if differing:
        raise UserError(
            f"{printable(out)} holds another {kind}, with other {', '.join(differing)}; name "
            "another folder with --out, or delete it"
        )


class GapRecord(Protocol):
    """Describe what knows of gaps in results, such as episodes left out, as ids by kind."""

    def new_gaps(self) -> Mapping[str, Collection[str]]:
        """Return the ids of what results lack, by kind, that were not returned before."""
        ...

    def recall_gaps(self, gaps: Mapping[str, Collection[str]]) -> None:
        """Take over the gaps of results that were kept: ids by kind."""
        ...


class Cells:
    """Keep finished parts of a study in a file, one a line, so that a killed study can continue.

    It is made from the file, the digest of all settings that decide a part, whether parts are
    `computed` here, unlike a model's replies, and what they are computed of, if it knows of gaps in
    results. A part that was made of other settings than this study's is not taken, nor is a
    computed one that was not computed by this user on this machine: anybody may have written the
    file. Gaps are kept with the part that came upon them, so that a study says them again.
    """

    def __init__(
        self, path: Path, depends_on: str, computed: bool = True, source: GapRecord | None = None
    ) -> None:
        """Read a file. Torn lines and those of another digest of all that decides a part do not
        count, and without a seal those that are `computed`, unlike a model's replies. Nor do those
        without gaps, as older versions wrote them, if the `source` knows of some.
        """
        self._path, self._of, self._computed = path, depends_on, computed
        self._source = source
        data = bytes_of(path, "rows") if is_there(path) else b""
        self._torn = bool(data) and not data.endswith(b"\n")
        self._cells = dict(self._read(data))

    def _read(self, data: bytes) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
        for line in data.splitlines():
            try:
                kept = json.loads(line)
                if kept["of"] == self._of and (not self._computed or self._is_sealed(kept)):
                    part = {k: _array(v) for k, v in kept["cell"].items()}
                    if self._source:
                        self._source.recall_gaps(kept["gaps"])
                    yield tuple(kept["key"]), part
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue

    def _is_sealed(self, kept: dict[str, Any]) -> bool:
        file_seal = kept.pop("seal", None)
        return file_seal is not None and file_seal == self._seal(kept)

    def _seal(self, kept: Mapping[str, Any]) -> str | None:
        return seal({"cell": json.dumps(kept, default=np.ndarray.tolist).encode()}, "a study")

    def __contains__(self, key: Sequence[Any]) -> bool:
        return tuple(key) in self._cells

    def part(
        self, key: Sequence[Any], compute: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return the stored result with this key, or compute and store it.

        A part is what a study computes at once, such as one point of its grid: a dict of values by
        name, plain or arrays with two axes, which are restored exactly. `key` are the settings that
        tell it from the others, and `compute` is called, without arguments, to make it.
        """
        there = self._cells.get(tuple(key))
        if there is not None:
            return there
        values = compute()
        kept: dict[str, Any] = {"of": self._of, "key": key, "cell": values}
        if self._source:
            kept["gaps"] = self._source.new_gaps()
        if self._computed:
            kept["seal"] = self._seal(kept)
        line = json.dumps(kept, default=np.ndarray.tolist)
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
