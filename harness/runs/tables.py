"""A run as pandas tables, for who computes with one: `harness.load`. Columns: docs/files.md."""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from harness.core.errors import UserError, printable
from harness.core.memory import uncollected
from harness.runs.folder import answers_of
from harness.runs.formats import DRIVE, EVAL

if TYPE_CHECKING:
    import pandas as pd

# Names stay text: a model may be called "null" and a prompt "1".
TEXT = (
    "model", "prompt", "answer", "condition", "metric", "interval", "danger", "failure", "partner", "striker",
    "fault",
)  # fmt: skip
MESSAGE = ("risk", "evidence", "recommended_maneuver", "confidence")  # what a helper says beside its intent
_BROKEN = (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, csv.Error)
Row = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Tables:
    """A finished run, frozen or live. A table is read when it is first asked for.

    Every table raises UserError if its file is missing or broken.

    Attributes:
        path: its folder.
        config: run.json.
    """

    path: Path
    config: Mapping[str, Any] = field(repr=False)

    @cached_property
    def summary(self) -> "pd.DataFrame":
        """A row a condition, metric and interval: summary.csv."""
        return self._csv("summary.csv")

    @cached_property
    def episodes(self) -> "pd.DataFrame":
        """A row an episode, condition and seed: episodes.csv."""
        return self._csv("episodes.csv")

    @property
    def decisions(self) -> "pd.DataFrame":
        """A row a scene, condition and seed: what was decided, and from what."""
        return self._rows[0]

    @property
    def answers(self) -> "pd.DataFrame":
        """A row a scene and viewer, and a row a second answer of the ego (role `merge`): raw and as read."""
        return self._rows[1]

    def _csv(self, name: str) -> "pd.DataFrame":
        import pandas as pd

        return _whole(
            self.path / name,
            lambda file: pd.read_csv(
                file,
                dtype=dict.fromkeys(TEXT, str),
                keep_default_na=False,
                na_values=[""],
                float_precision="round_trip",
            ),
        )

    @cached_property
    def _rows(self) -> "tuple[pd.DataFrame, pd.DataFrame]":
        return _whole(self.path / "rows.jsonl", self._read_rows)

    @uncollected()
    def _read_rows(self, file: Path) -> "tuple[pd.DataFrame, pd.DataFrame]":
        actions: Sequence[str] = self.config["actions"]
        decisions: list[Row] = []
        answers: list[Row] = []
        with file.open(encoding="utf-8") as lines:
            for row in map(json.loads, lines):
                place = {key: row[key] for key in ("scene", "episode", "step", "danger")}
                # What each action leads to is known of a frozen scene alone.
                known = {
                    f"{name}_{action}": value
                    for name in ("safe", "delay_s") if name in row
                    for action, value in zip(actions, row[name], strict=True)
                }  # fmt: skip
                decisions += ({**place, **_decision(d, actions), **known} for d in row["decisions"])
                for viewers, answer in answers_of(row).items():
                    viewer, _, heard = viewers.partition("+")
                    answers.append({**place, "viewer": viewer, "heard": heard, **_answer(answer, actions)})
        return _table(decisions), _table(answers)


def load(run: Path) -> Tables:
    """A run by its folder.

    Raises:
        UserError: it is no finished run, or one of another version.
    """
    file = run / "run.json"
    if not file.is_file():
        raise UserError(
            f"{printable(run)} is no finished run: it has no run.json; "
            "give a folder made by `harness eval` or `harness drive`"
        )
    config: Any = _whole(file, lambda file: json.loads(file.read_text(encoding="utf-8")))
    if not isinstance(config, dict) or config.get("format") not in (EVAL, DRIVE):
        found = config.get("format") if isinstance(config, dict) else None
        raise UserError(
            f"{printable(file)} has format {printable(found)!r}; this harness reads {EVAL!r} and {DRIVE!r}"
        )
    return Tables(run, config)


def _whole(file: Path, reader: Callable[[Path], T]) -> T:
    try:
        return reader(file)
    except _BROKEN as error:
        raise UserError(f"{printable(file)} cannot be read ({printable(error)}); run again") from None


def _spread(name: str, values: Sequence[float] | None, actions: Sequence[str]) -> Row:
    """A distribution as a column an action."""
    known: Sequence[float | None] = values or [None] * len(actions)
    return {f"{name}_{action}": p for action, p in zip(actions, known, strict=True)}


def _decision(decision: Row, actions: Sequence[str]) -> Row:
    first = {key: decision[key] for key in ("condition", "seed", "action")}
    plain = {key: value for key, value in decision.items() if key not in ("fused", "messages")}
    sent = {
        f"{key}_{message['from']}": value
        for message in decision["messages"]
        for key, value in message.items() if key != "from"
    }  # fmt: skip
    return {**first, **plain, **_spread("fused", decision["fused"], actions), **sent}


def _answer(answer: Row, actions: Sequence[str]) -> Row:
    plain = {key: value for key, value in answer.items() if key not in ("intent", "message", "repairs")}
    said = {key: (answer["message"] or {}).get(key) for key in MESSAGE}
    repairs = " ".join(answer["repairs"])
    return {**plain, "repairs": repairs, **_spread("intent", answer["intent"], actions), **said}


def _table(rows: list[Row]) -> "pd.DataFrame":
    import pandas as pd

    # What is true, false or unknown stays so; numbers keep NaN, and so does what no row knows.
    table = pd.DataFrame(rows).convert_dtypes(
        convert_string=False, convert_integer=False, convert_floating=False
    )
    return table.astype(dict.fromkeys(table.columns[table.isna().all()], float))
