"""A run folder, read again: for its report, and to be coordinated otherwise."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.dataset.load import Dataset, find, load
from harness.errors import UserError, printable
from harness.run.spec import FORMAT

Row = dict[str, Any]  # one decision point of rows.jsonl


@dataclass(frozen=True)
class Kind:
    """A kind of run folder: the format it states, the command that makes it, the keys it must have."""

    format: str
    command: str
    needed: tuple[str, ...]
    needed_in_row: tuple[str, ...]


FROZEN = Kind(
    FORMAT, "harness eval", ("model", "prompt", "dataset", "actions", "conditions", "seeds", "latency"),
    ("scene", "episode", "answers", "safe", "delay_s", "decisions"),
)  # fmt: skip


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
    def conditions(self) -> tuple[str, ...]:
        """Names of the operating points, in the run's order."""
        return tuple(str(condition["name"]) for condition in self.config["conditions"])

    def score(self, condition: str, metric: str) -> Score | None:
        """A metric's value in one condition; where it has several intervals, the one over episodes."""
        found = [
            s for s in self.scores if (s.condition, s.metric) == (condition, metric) and s.value is not None
        ]
        return min(found, key=lambda s: s.interval != "episodes", default=None)


def read(path: Path, kinds: Sequence[Kind] = (FROZEN,)) -> Run:
    """Read a run folder of one of these kinds.

    Raises:
        UserError: it is none, or a file of it is missing or broken.
    """
    commands = " or ".join(f"`{kind.command}`" for kind in kinds)
    if not (path / "run.json").is_file():
        raise UserError(f"{printable(path)} is no run: it has no run.json; give a folder made by {commands}")
    config = _parsed(path / "run.json", json.loads, _text(path / "run.json"))
    found = config.get("format") if isinstance(config, dict) else None
    by_format = {kind.format: kind for kind in kinds}
    if not isinstance(found, str) or found not in by_format:
        raise UserError(
            f"{printable(path / 'run.json')} has format {printable(found)!r}; "
            f"this command reads {' and '.join(map(repr, by_format))}: give a run of {commands}"
        )
    kind = by_format[found]
    _need(path / "run.json", config, kind.needed)
    scores = _parsed(path / "summary.csv", _scores, _text(path / "summary.csv"))
    rows = []
    for number, line in enumerate(_text(path / "rows.jsonl").split("\n"), 1):
        if line.strip():
            where = f"{path / 'rows.jsonl'} line {number}"
            row = _parsed(where, json.loads, line)
            _need(where, row, kind.needed_in_row)
            rows.append(row)
    if not rows:
        raise UserError(f"{printable(path / 'rows.jsonl')} holds no decisions; make the run again")
    return Run(path, config, scores, tuple(rows))


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


def _scores(text: str) -> tuple[Score, ...]:
    lines = csv.DictReader(text.splitlines())
    return tuple(
        Score(
            line["condition"],
            line["metric"],
            _number(line["value"]),
            _number(line["ci_low"]),
            _number(line["ci_high"]),
            int(line["n"]),
            int(line["n_excluded"] or 0),
            line["interval"],
        )
        for line in lines
    )


def _number(text: str) -> float | None:
    value = float(text or "nan")
    return None if value != value else value
