"""The table of decisions: a row a decision point, condition and seed. The file `decisions.parquet`."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.core.arrays import Bools, Floats, Ints
from harness.core.files import replacing
from harness.runs.records import Decision, Message

if TYPE_CHECKING:
    import pandas as pd

LABEL, WHOLE, FLAG, NUMBER = pa.dictionary(pa.int32(), pa.string()), pa.int64(), pa.bool_(), pa.float64()
# Unknown is null in the file and NaN in arrays; docs/files.md has the meaning of each column.
COLUMNS = {
    "scene": LABEL, "episode": WHOLE, "step": WHOLE, "danger": LABEL, "condition": LABEL, "seed": WHOLE,
    "action": LABEL, "messages": WHOLE, "requests": WHOLE, "request_bits": NUMBER, "reply_bits": NUMBER,
    "airtime_ms": NUMBER, "busy_ratio": NUMBER, "inference_j": NUMBER, "helpers_j": NUMBER,
    "radio_mj": NUMBER, "waiting_j": NUMBER, "own_failed": FLAG, "triggered": FLAG, "entropy_nats": NUMBER,
    "normalised_entropy": NUMBER, "own_weight": NUMBER, "latency_ms": NUMBER, "deadline_missed": FLAG,
    "fusion_ms": NUMBER, "fusion_failed": FLAG, "effective_loss": NUMBER, "observed_loss": NUMBER,
    "value": FLAG, "safe": FLAG, "regret": FLAG, "delay_s": NUMBER, "off_lag": FLAG, "acts_at_s": NUMBER,
    "acted": FLAG,
}  # fmt: skip
# A file of decisions that know nothing of these lacks them.
OPTIONAL = ("busy_ratio", "inference_j", "helpers_j", "radio_mj", "waiting_j")
NEVER_UNKNOWN = ("scene", "episode", "step", "condition", "seed", "action")
# A column an action: the policy, and the outcome of each action.
OF_ACTIONS = {"fused": NUMBER, "safe": FLAG, "delay_s": NUMBER}
# A column a message's place, from 1: who was asked, and the fate of the reply.
OF_MESSAGES = {
    "helper": LABEL, "delivered": FLAG, "on_time": FLAG, "arrival_ms": NUMBER, "weight": NUMBER,
    "trust": NUMBER, "attacker": FLAG,
}  # fmt: skip
DECIMALS = {  # that are kept: enough for every figure, and the same on every machine
    "entropy_nats": 6, "normalised_entropy": 6, "own_weight": 6, "latency_ms": 3, "fusion_ms": 3, "fused": 6,
    "airtime_ms": 6, "busy_ratio": 6, "inference_j": 6, "helpers_j": 6, "radio_mj": 6, "waiting_j": 6,
    "arrival_ms": 3, "weight": 6, "trust": 6,
}  # fmt: skip

ROWS = 2048  # that become mappings at a time


def schema(actions: Sequence[str], helpers: int) -> pa.Schema:
    """Names and types of the columns, in the order of the file."""
    return pa.schema([
        *COLUMNS.items(),
        *((f"{name}_{action}", kind) for name, kind in OF_ACTIONS.items() for action in actions),
        *((f"{name}_{n}", kind) for n in range(1, helpers + 1) for name, kind in OF_MESSAGES.items()),
    ])  # fmt: skip


def by_action(name: str, values: Any, actions: Sequence[str]) -> dict[str, Any]:
    """Columns of values (n, A)."""
    return {f"{name}_{action}": values[:, place] for place, action in enumerate(actions)}


def by_message(name: str, values: Any) -> dict[str, Any]:
    """Columns of values (n, H)."""
    return {f"{name}_{place + 1}": values[:, place] for place in range(values.shape[1])}


@dataclass(frozen=True)
class Labels:
    """Names (n,), each kept once: `names[code]`, none where a code is negative."""

    codes: Ints
    names: Sequence[str]


@dataclass(frozen=True)
class Decisions:
    """Decisions as columns (n,).

    Attributes:
        table: the columns of `schema`.
        actions: meta-actions, in the order of every distribution.
        helpers: most helpers that a decision point has.
    """

    table: pa.Table
    actions: tuple[str, ...]
    helpers: int
    _arrays: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)
    _rows: dict[int, list[dict[str, Any]]] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, columns: Mapping[str, Any], actions: Sequence[str], helpers: int) -> "Decisions":
        """From arrays and `Labels` (n,) by name; a column that is not given is unknown."""
        n = len(columns["seed"])
        fields = schema(actions, helpers)
        arrays = {
            name: _array(columns[name], kind) if name in columns else pa.nulls(n, kind)
            for name, kind in zip(fields.names, fields.types, strict=True)
        }
        return cls(pa.table(arrays), tuple(actions), helpers)

    @classmethod
    def concat(cls, parts: Sequence["Decisions"]) -> "Decisions":
        """Decisions of the same actions, one after the other."""
        actions, helpers = parts[0].actions, max(part.helpers for part in parts)
        tables = pa.concat_tables([part.table for part in parts], promote_options="default")
        return cls(tables.select(schema(actions, helpers).names).unify_dictionaries(), actions, helpers)

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, name: str) -> Floats:
        """Numbers or flags (n,) as floats; NaN where unknown."""
        if name not in self._arrays:
            self._arrays[name] = _values(self.table[name].cast(NUMBER), np.nan, np.float64)
        return self._arrays[name]

    def whole(self, name: str) -> Ints:
        """Whole numbers (n,)."""
        return cast(Ints, _values(self.table[name], 0, np.int64))

    def flags(self, name: str) -> Bools:
        """Whether a flag is known and true, (n,)."""
        return np.asarray(self[name] == 1.0)

    def of_actions(self, name: str) -> Floats:
        """A distribution, or the outcome of each action: (n, A)."""
        key = f"{name} of actions"
        if key not in self._arrays:
            self._arrays[key] = np.stack([self[f"{name}_{action}"] for action in self.actions], axis=-1)
        return self._arrays[key]

    def of_messages(self, name: str) -> Floats:
        """Numbers or flags of messages, (n, H); NaN where nobody was asked."""
        columns = [self[f"{name}_{place}"] for place in range(1, self.helpers + 1)]
        return np.stack(columns, axis=-1) if columns else np.empty((len(self), 0))

    def codes(self, name: str, names: Sequence[str]) -> Ints:
        """Position of each label among `names`, (n,); -1 where there is none. ValueError for any other."""
        column = self.table[name].combine_chunks()
        position = {label: place for place, label in enumerate(names)}
        own = column.dictionary.to_pylist()
        if others := [label for label in own if label not in position]:
            raise ValueError(f"unknown {name} {others[0]!r}")
        lookup = np.array([*(position[label] for label in own), -1])
        return cast(Ints, lookup[_values(column.indices, len(own), np.int32)])

    def labels(self, name: str) -> list[str | None]:
        """Labels (n,)."""
        return cast("list[str | None]", self.table[name].to_pylist())

    @cached_property
    def scenes(self) -> dict[str, range]:
        """The rows of each decision point, in order. Raises ValueError unless they stand together."""
        codes = self.table["scene"].combine_chunks()
        changes = np.flatnonzero(np.diff(_values(codes.indices, -1, np.int32))) + 1
        starts = [0, *changes.tolist(), len(self)]
        names = codes.dictionary.to_pylist()
        ranges = {
            names[codes.indices[start].as_py()]: range(start, stop)
            for start, stop in pairwise(starts)
            if stop > start
        }
        if len(ranges) < len(starts) - 1:
            raise ValueError("the decisions of one decision point do not stand together")
        return ranges

    def records(self, start: int, stop: int) -> list[Decision]:
        """Some rows, one by one."""
        return [self._record(self._row(place)) for place in range(start, stop)]

    def _row(self, place: int) -> Mapping[str, Any]:
        chunk, n = divmod(place, ROWS)
        if chunk not in self._rows:  # the last is kept, since rows are read in order
            self._rows.clear()
            self._rows[chunk] = self.table.slice(chunk * ROWS, ROWS).to_pylist()
        return self._rows[chunk][n]

    def _record(self, row: Mapping[str, Any]) -> Decision:
        messages = tuple(
            Message(sender, *(row[f"{name}_{place}"] for name in OF_MESSAGES if name != "helper"))
            for place in range(1, self.helpers + 1)
            if (sender := row[f"helper_{place}"]) is not None
        )
        plain = {name: row[name] for name in Decision.__struct_fields__ if name in COLUMNS}
        fused = tuple(row[f"fused_{action}"] for action in self.actions)
        return Decision(**{**plain, "fused": fused, "messages": messages})

    def infinite(self) -> str | None:
        """Name of a column with an infinite number; None if there is none."""
        numbers = [column.name for column in self.table.schema if column.type == NUMBER]
        return next((name for name in numbers if pc.any(pc.is_inf(self.table[name])).as_py()), None)

    def take(self, which: Any) -> "Decisions":
        """Some of the decisions, by their positions."""
        places = _of_buffer(np.asarray(which, dtype=np.int64), None, WHOLE)
        return Decisions(self.table.take(places), self.actions, self.helpers)

    def replace(self, **columns: Any) -> "Decisions":
        """The same with other arrays (n,) in some columns."""
        table = self.table
        for name, values in columns.items():
            place = table.schema.get_field_index(name)
            table = table.set_column(place, name, _array(values, table.schema.field(name).type))
        return Decisions(table, self.actions, self.helpers)

    def rounded(self) -> "Decisions":
        """With the decimals that are kept."""
        decimals = {
            column: kept
            for name, kept in DECIMALS.items()
            for column in self.table.column_names
            if column == name or (name not in COLUMNS and column.startswith(f"{name}_"))
        }
        return self.replace(**{column: self[column].round(kept) for column, kept in decimals.items()})

    def write(self, path: Path) -> None:
        """Replace a Parquet file. Equal rows give equal bytes: names are numbered as rows first have them."""
        with replacing(path) as part:
            self._write(part)

    def encoded(self) -> bytes:
        """The bytes that `write` writes."""
        data = BytesIO()
        self._write(data)
        return data.getvalue()

    def _write(self, to: Path | BytesIO) -> None:
        unknown = [name for name in OPTIONAL if self.table[name].null_count == len(self)]
        table = self.table.drop_columns(unknown).combine_chunks()
        columns = [
            column.cast(pa.string()).dictionary_encode() if column.type == LABEL else column
            for column in table.columns
        ]
        pq.write_table(pa.table(columns, schema=table.schema), to, compression="zstd")

    @classmethod
    def read(cls, path: Path, actions: Sequence[str]) -> "Decisions":
        """Read a Parquet file. Raises OSError or ValueError if it is none, or has not a run's columns."""
        with arrow_file(path) as file:  # not read_table, which takes names of folders for columns
            table = pq.ParquetFile(file).read()
        for name in OPTIONAL:
            if name not in table.column_names:
                table = table.append_column(name, pa.nulls(len(table), NUMBER))
        helpers = sum(name.startswith("helper_") for name in table.column_names)
        wanted = schema(actions, helpers)
        if missing := [name for name in wanted.names if name not in table.column_names]:
            raise ValueError(f"it lacks {', '.join(missing)}")
        for name in NEVER_UNKNOWN:
            if table[name].null_count:
                raise ValueError(f"{name} is unknown in some rows")
        return cls(table.select(wanted.names).cast(wanted).unify_dictionaries(), tuple(actions), helpers)

    def frame(self) -> "pd.DataFrame":
        """For pandas: names are categories, and what is true, false or unknown stays so."""
        import pandas as pd

        return cast("pd.DataFrame", self.table.to_pandas(types_mapper={FLAG: pd.BooleanDtype()}.get))


def arrow_file(path: Path) -> pa.OSFile:
    """A file open for Arrow's threads, which can abort the process when they let go of one of Python's."""
    with path.open("rb"):  # which says in few words why a file cannot be opened
        return pa.OSFile(os.fsencode(path))


# Where pyarrow turns what is not its own into an array, or the reverse, it loads pandas: buffers spare that.


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    """A column of an array or of `Labels`; null where it is NaN or no label."""
    if isinstance(values, Labels):
        codes = _of_buffer(values.codes.astype(np.int32), values.codes >= 0, pa.int32())
        texts = [name.encode() for name in values.names]
        ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        names = pa.StringArray.from_buffers(len(texts), pa.py_buffer(ends), pa.py_buffer(b"".join(texts)))
        return pa.DictionaryArray.from_arrays(codes, names)
    if kind == WHOLE:
        return _of_buffer(values.astype(np.int64), None, kind)
    numbers = values.astype(np.float64)
    return _of_buffer(numbers, ~np.isnan(numbers), NUMBER).cast(kind)


def _of_buffer(values: Any, known: Any, kind: pa.DataType) -> pa.Array:
    mask = None if known is None else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(kind, len(values), [mask, pa.py_buffer(np.ascontiguousarray(values))])


def _values(column: Any, unknown: float | int, kind: type) -> Any:
    """A column's values (n,), `unknown` in place of nulls."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    mask, data = array.buffers()
    values: Any = np.frombuffer(data, kind, len(array), array.offset * np.dtype(kind).itemsize)
    if not array.null_count:
        return values
    end = array.offset + len(array)
    known = np.unpackbits(np.frombuffer(mask, np.uint8), count=end, bitorder="little")[array.offset :]
    return np.where(known, values, unknown)
