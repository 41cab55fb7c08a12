"""A run folder, read again: for its report, to be coordinated otherwise, and to be played again."""

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from harness.core.errors import UserError, printable
from harness.dataset.load import Dataset, find, load
from harness.runs.formats import EVAL

T = TypeVar("T")
Row = dict[str, Any]  # one decision point of rows.jsonl


@dataclass(frozen=True)
class Form:
    """What a run of one kind has.

    Attributes:
        format: what its run.json says it is.
        command: what makes it.
        needed: keys of its run.json.
        needed_in_row: keys of each row of its rows.jsonl.
    """

    format: str
    command: str
    needed: tuple[str, ...]
    needed_in_row: tuple[str, ...]


NEEDED = ("model", "prompt", "actions", "conditions", "seeds", "latency")
NEEDED_IN_ROW = ("scene", "episode", "danger", "answers", "decisions")
FROZEN = Form(EVAL, "harness eval", (*NEEDED, "dataset"), (*NEEDED_IN_ROW, "safe", "delay_s"))


@dataclass(frozen=True)
class Score:
    """One line of summary.csv.

    Attributes:
        condition: name of the operating point, or `all` for what does not depend on it.
        metric: name of the metric, its unit at the end.
        value: the mean; None if there was nothing to average.
        low: lower end of the 95 % interval; None where the data cannot bound it.
        high: upper end.
        n: units behind it.
        n_excluded: units without a value.
        interval: what the units are: `episodes`, `seed means` or `answers`.
    """

    condition: str
    metric: str
    value: float | None
    low: float | None
    high: float | None
    n: int
    n_excluded: int
    interval: str


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        path: its folder.
        config: run.json.
        scores: summary.csv.
        rows: rows.jsonl.
    """

    path: Path
    config: Mapping[str, Any]
    scores: tuple[Score, ...]
    rows: tuple[Row, ...]

    @property
    def answer(self) -> str:
        """Its answer mode; runs of older versions name none, and had one."""
        return str(self.config.get("answer", "json"))

    @property
    def source(self) -> str:
        """What its episodes are of."""
        return str(self.config["dataset"].get("name"))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the operating points, in the run's order."""
        return tuple(str(condition["name"]) for condition in self.config["conditions"])

    def score(self, condition: str, metric: str) -> Score | None:
        """A metric's value in one condition; where it has several intervals, the one over episodes."""
        found = [
            s for s in self.scores if (s.condition, s.metric) == (condition, metric) and s.value is not None
        ]
        return min(found, key=lambda s: s.interval != "episodes", default=None)


def answers_of(row: Row) -> dict[str, Row]:
    """All answers of a row: by viewer, and the ego's second ones by whose messages they had."""
    return {**row["answers"], **row.get("merged", {})}


def read(path: Path, *forms: Form) -> Run:
    """Read a run folder of one of these forms; of a frozen run, where none is given.

    Raises:
        UserError: it is none, or a file of it is missing or broken.
    """
    forms = forms or (FROZEN,)
    makers = " or ".join(f"`{form.command}`" for form in forms)
    if not (path / "run.json").is_file():
        raise UserError(f"{printable(path)} is no run: it has no run.json; give a folder made by {makers}")
    config = _parsed(path / "run.json", json.loads, _text(path / "run.json"))
    found = config.get("format") if isinstance(config, dict) else None
    form = next((form for form in forms if form.format == found), None)
    if form is None:
        raise UserError(
            f"{printable(path / 'run.json')} has format {printable(found)!r}, not "
            f"{' or '.join(repr(form.format) for form in forms)}; give a folder made by {makers}"
        )
    _need(path / "run.json", config, form.needed)
    scores = table(path / "summary.csv", _score)
    rows = []
    for n, line in enumerate(_text(path / "rows.jsonl").split("\n"), 1):
        if line.strip():
            where = f"{path / 'rows.jsonl'} line {n}"
            row = _parsed(where, json.loads, line)
            _need(where, row, form.needed_in_row)
            rows.append(row)
    if not rows:
        raise UserError(f"{printable(path / 'rows.jsonl')} holds no decisions; make the run again")
    return Run(path, config, scores, tuple(rows))


def table(file: Path, row: Callable[[Mapping[str, str]], T]) -> tuple[T, ...]:
    """What `row` makes of each line of a CSV file. Raises UserError if it is missing or broken."""
    rows: tuple[T, ...] = _parsed(
        file, lambda text: tuple(map(row, csv.DictReader(text.splitlines()))), _text(file)
    )
    return rows


def dataset_of(run: Run) -> Dataset:
    """The dataset that the run was made on, the very same bytes.

    Raises:
        UserError: it is not there, or has changed since.
    """
    stated = run.config["dataset"]
    path = Path(str(stated["path"]))
    dataset = load(path if path.is_dir() else find(str(stated["name"])))
    if dataset.sha256 != stated["sha256"]:
        raise UserError(
            f"dataset {printable(dataset.path)} is not the one that {printable(run.path)} was made on "
            f"(sha256 {dataset.sha256[:12]}…, not {printable(stated['sha256'], 13)}); restore it or run again"
        )
    return dataset


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8"
        raise UserError(f"cannot read {printable(file)}: {reason}; make the run again") from None


def _parsed(where: object, reader: Any, text: str) -> Any:
    try:
        return reader(text)
    except (ValueError, KeyError, TypeError, RecursionError, csv.Error) as error:
        raise UserError(f"{printable(where)} is broken ({printable(error)}); make the run again") from None


def _need(where: object, found: Any, keys: Iterable[str]) -> None:
    missing = [key for key in keys if not isinstance(found, dict) or key not in found]
    if missing:
        raise UserError(f"{printable(where)} lacks {', '.join(missing)}; make the run again")


def _score(line: Mapping[str, str]) -> Score:
    return Score(
        line["condition"],
        line["metric"],
        number(line["value"]),
        number(line["ci_low"]),
        number(line["ci_high"]),
        int(line["n"]),
        int(line["n_excluded"] or 0),
        line["interval"],
    )


def number(text: str) -> float | None:
    """A number of a CSV file; None where it is empty or NaN."""
    value = float(text or "nan")
    return None if value != value else value
