"""The table of decisions, `decisions.parquet`:
one row for each decision point, condition and seed.
"""

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.core.arrays import Bools, Floats, Ints
from harness.core.files import opened, replacing
from harness.core.memory import return_large_blocks
from harness.runs import formats
from harness.runs.packed import Packed, of_buffer
from harness.runs.records import Decision, Message
from harness.runs.timers import added_columns

if TYPE_CHECKING:
    import pandas as pd

LABEL = pa.dictionary(pa.int32(), pa.string())
WHOLE, FLAG, NUMBER = pa.int64(), pa.bool_(), pa.float64()
MOST = 2**53  # of a number in a table; up to here a float has every whole number
# Unknown is null in the file and NaN in arrays. A column without a comment means what the field of
# `records.Decision` does. What times answers may add some (`timers.added_columns`).
COLUMNS = {
    "scene": LABEL,
    "episode": WHOLE,
    "step": WHOLE,
    "danger": LABEL,
    "condition": LABEL,
    "seed": WHOLE,
    "action": LABEL,
    "messages": WHOLE,  # number of replies that were scheduled
    "requests": WHOLE,  # requests broadcast; 0 if nobody was asked
    "request_bits": NUMBER,  # size of the requests
    "reply_bits": NUMBER,  # size of the scheduled replies
    # number of messages that helpers sent unasked since the decision before; unknown, like the next
    # and `unasked_ms`, where they send nothing so
    "unasked": NUMBER,
    "unasked_bits": NUMBER,  # their size
    "airtime_ms": NUMBER,  # time on air of all; unknown where the channel model does not know it
    "unasked_ms": NUMBER,  # the part of it of messages sent unasked
    "busy_ratio": NUMBER,  # share of time that the channel is busy, where its model knows that
    "own_failed": FLAG,
    "triggered": FLAG,
    "entropy_nats": NUMBER,
    "normalised_entropy": NUMBER,  # the same as a share of the most there can be
    "own_weight": NUMBER,
    "latency_ms": NUMBER,
    "deadline_missed": FLAG,
    "fusion_ms": NUMBER,
    "fusion_failed": FLAG,  # whether the fusion call's answer could not be parsed
    "effective_loss": NUMBER,  # probability that one transmission is lost
    "observed_loss": NUMBER,  # share of scheduled replies that did not arrive
    "value": FLAG,
    "safe": FLAG,
    "regret": FLAG,
    "delay_s": NUMBER,
    "off_lag": FLAG,
    "acts_at_s": NUMBER,
    "acted": FLAG,
    # whether it made harm inevitable, which was not before; frozen only, like the next
    "miss": FLAG,
    "false_alarm": FLAG,  # whether it gave success away, and harm could still be avoided
    "ttc_s": NUMBER,  # least time to collision until the next decision begins
    "pet_s": NUMBER,  # least post-encroachment time until then
    "short_ttc": FLAG,  # whether the time to collision was below 1.5 s
    "short_pet": FLAG,  # whether the post-encroachment time was below 1.5 s
    "agent": LABEL,
    "broke_word": FLAG,  # whether the vehicle did otherwise than the plan that it sent
}
# A file has no such column, and none that was added, if all its values are unknown.
OPTIONAL = (
    "unasked",
    "unasked_bits",
    "unasked_ms",
    "busy_ratio",
    "miss",
    "false_alarm",
    "ttc_s",
    "pet_s",
    "short_ttc",
    "short_pet",
    "agent",
    "broke_word",
)
NEVER_UNKNOWN = ("scene", "episode", "step", "condition", "seed", "action")
# One column for each action: the policy, and the outcome of the action.
OF_ACTIONS = {
    "fused": NUMBER,  # the policy: the action's probability after fusion
    "safe": FLAG,  # whether success would still be possible after the action; frozen only
    "delay_s": NUMBER,  # by how much the action would put off the earliest success; frozen only
}
# One column for each message, numbered from 1: the helper asked, and what became of its reply, as
# `records.Message` has it.
OF_MESSAGES = {
    "helper": LABEL,  # the helper that was asked
    "delivered": FLAG,
    "on_time": FLAG,
    "arrival_ms": NUMBER,
    "weight": NUMBER,
    "trust": NUMBER,
    "attacker": FLAG,
}
DECIMALS = {  # enough for every figure, and few enough to be the same on every machine
    "entropy_nats": 6,
    "normalised_entropy": 6,
    "own_weight": 6,
    "latency_ms": 3,
    "fusion_ms": 3,
    "fused": 6,
    "airtime_ms": 6,
    "unasked_ms": 6,
    "busy_ratio": 6,
    "arrival_ms": 3,
    "weight": 6,
    "trust": 6,
}
DECIMALS_ADDED = 6

# bytes of a cell at most, before compression, and of what all files have
CELL, SLACK = 256, 1 << 26
ROWS = 2048  # how many rows become mappings at a time
ROW_GROUP = 1 << 18  # least rows of a group in the file but the last: about 0.1 GB in memory
KEPT = 1 << 26  # most bytes of columns that are kept as arrays


def schema(actions: Sequence[str], helpers: int) -> pa.Schema:
    """Return the Arrow schema of decisions: names and types of the columns, in order.

    `actions` are the names of the meta-actions, for which some columns are repeated, and `helpers`
    is the greatest number of messages in a decision, for which others are.
    """
    columns, added = [], added_columns()
    for name, kind in COLUMNS.items():
        columns.append((name, kind))
        columns += [(each, NUMBER) for each, behind in added.items() if behind == name]
    for name, kind in OF_ACTIONS.items():
        columns += [(f"{name}_{action}", kind) for action in actions]
    for n in range(1, helpers + 1):
        columns += [(f"{name}_{n}", kind) for name, kind in OF_MESSAGES.items()]
    return pa.schema(columns)


def by_action(name: str, values: Any, actions: Sequence[str]) -> dict[str, Any]:
    """Return values of n decisions and A actions, (n, A), as columns (n,) of a table, by name.

    There is a column for each of `actions`, whose name begins with `name`, such as `fused_IDLE`.
    """
    return {f"{name}_{action}": values[:, place] for place, action in enumerate(actions)}


def by_message(name: str, values: Any) -> dict[str, Any]:
    """Return values of n decisions and H messages, (n, H), as columns (n,) of a table, by name.

    There is a column for each message, counted from 1, whose name begins with `name`, such as
    `delivered_1`.
    """
    return {f"{name}_{place + 1}": values[:, place] for place in range(values.shape[1])}


@dataclass(frozen=True)
class Labels:
    """Hold a name for each of n rows in a compact form.

    `codes`, (n,), has each row's index in `names`, negative for a row without a name.
    """

    codes: Ints  # index in `names` of each row's name, (n,); negative for a row without one
    names: Sequence[str]  # the names, each once


@dataclass(frozen=True)
class Decisions:
    """Hold n decisions of a run as a table, one row for each decision point, condition and seed.

    A decision point is one situation in which a decision is due. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages under which it is decided,
    and the seed is that of the channel's random numbers. `actions` are the names of the A
    meta-actions, in the order of every distribution, and `helpers` is the greatest number of
    messages in a decision. Columns of `rows` are read by name as arrays (n,), or (n, A), of which
    `_arrays` keeps some, and its rows as dicts, of which `_rows` keeps some. More than `ROW_GROUP`
    rows of a file stay packed, and `pieces` reads them some at a time.
    """

    rows: pa.Table | Packed  # its columns, (n,) each, are those of `schema`
    # names of the meta-actions, in the order of every distribution over them
    actions: tuple[str, ...]
    helpers: int  # the greatest number of messages in a decision: of columns such as `helper_1`
    # columns that were read as arrays, by name, kept for the next call
    _arrays: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)
    # rows that were read as dicts, by the index of their chunk, kept for the next call
    _rows: dict[int, list[dict[str, Any]]] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, columns: Mapping[str, Any], actions: Sequence[str], helpers: int) -> "Decisions":
        """Build n decisions from the values (n,) of each column: an array, or `Labels` of names.

        `columns` has them by name; missing ones are unknown. `actions` are the names of the
        meta-actions, `helpers` the greatest number of messages in a decision.
        """
        n = len(columns["seed"])
        fields = schema(actions, helpers)
        arrays = {
            name: _array(columns[name], kind) if name in columns else pa.nulls(n, kind)
            for name, kind in zip(fields.names, fields.types, strict=True)
        }
        return cls(pa.table(arrays), tuple(actions), helpers)

    @classmethod
    def concat(cls, parts: Sequence["Decisions"]) -> "Decisions":
        """Return the decisions of several tables, one after another; all have the same actions.

        Columns of messages are as many as in the table with the most.
        """
        actions, helpers = parts[0].actions, max(part.helpers for part in parts)
        tables = pa.concat_tables([part.table for part in parts], promote_options="default")
        return cls(
            tables.select(schema(actions, helpers).names).unify_dictionaries(), actions, helpers
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def table(self) -> pa.Table:
        """Return all rows in memory, (n,) a column."""
        return self.rows.whole() if isinstance(self.rows, Packed) else self.rows

    def pieces(self) -> "Iterator[Decisions]":
        """Yield the decisions some at a time, in order, since columns of all may be large."""
        if isinstance(self.rows, Packed):
            for piece in self.rows.pieces():
                yield Decisions(piece, self.actions, self.helpers)
        else:
            yield self

    def __getitem__(self, name: str) -> Floats:
        """Return a column of numbers or flags (n,) as floats; NaN where unknown."""
        return self._kept(name, lambda: _values(self.rows[name].cast(NUMBER), np.nan, np.float64))

    def _kept(self, name: str, values: Callable[[], Floats]) -> Floats:
        """Return an array by its name, which is read if it is not kept. Nobody can change it:
        a package's metric is given the same as all others.
        """
        if name not in self._arrays:
            array = values()
            array.setflags(write=False)
            if array.nbytes + sum(each.nbytes for each in self._arrays.values()) > KEPT:
                self._arrays.clear()
            self._arrays[name] = array
        return self._arrays[name]

    def whole(self, name: str) -> Ints:
        """Return a column of whole numbers of the table of decisions, by its name, (n,)."""
        return cast(Ints, _values(self.rows[name], 0, np.int64))

    def flags(self, name: str) -> Bools:
        """Return in which of n decisions a yes-or-no column is true and known, (n,).

        `name` is the column's.
        """
        return np.asarray(self[name] == 1.0)

    def of_actions(self, name: str) -> Floats:
        """Return a value that each of A actions has in n decisions, such as `fused`, (n, A).

        `name` is the start of its columns' names, such as that of `fused_IDLE`; NaN where unknown.
        """
        names = [f"{name}_{action}" for action in self.actions]
        return self._kept(
            f"{name} of actions", lambda: np.stack([self[each] for each in names], axis=-1)
        )

    def of_messages(self, name: str) -> Floats:
        """Return a value that each of H messages has in n decisions, such as `on_time`, (n, H).

        `name` is the start of its columns' names, such as that of `on_time_1`; NaN where no helper
        was asked.
        """
        columns = [self[f"{name}_{place}"] for place in range(1, self.helpers + 1)]
        return np.stack(columns, axis=-1) if columns else np.empty((len(self), 0))

    def codes(self, name: str, names: Sequence[str]) -> Ints:
        """Return a column of labels as numbers: the index of each label in `names`, (n,).

        It is of n decisions, and -1 in a row without one. `name` is the column's. Raises ValueError
        for a label that is not in `names`.
        """
        column = self.rows[name].combine_chunks()
        position = {label: place for place, label in enumerate(names)}
        labels = column.dictionary.to_pylist()
        if unknown := [label for label in labels if label not in position]:
            raise ValueError(f"unknown {name} {unknown[0]!r}")
        lookup = np.array([*(position[label] for label in labels), -1])
        return cast(Ints, lookup[_values(column.indices, len(labels), np.int32)])

    def names(self, name: str) -> list[str]:
        """Return the labels that a column such as `agent` may have, each once, in any order."""
        return cast("list[str]", self.rows[name].combine_chunks().dictionary.to_pylist())

    def labels(self, name: str) -> list[str | None]:
        """Return a column of labels, such as `danger`, as a list of n texts; None where unknown."""
        column = self.rows[name].combine_chunks()
        names = [*column.dictionary.to_pylist(), None]
        return [names[code] for code in _values(column.indices, -1, np.int32).tolist()]

    @cached_property
    def scenes(self) -> dict[str, range]:
        """Return which rows of the table are about each scene, by the scene's id.

        They are ranges, since all rows of a scene (decision point) stand together. Raises
        ValueError if they do not.
        """
        if not len(self):
            return {}
        codes = self.rows["scene"].combine_chunks()
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
        return [self._record(self.row(index)) for index in range(start, stop)]

    def selected(self, names: Sequence[str]) -> "Decisions":
        return Decisions(self.rows.select(names), self.actions, self.helpers)

    def row(self, index: int) -> Mapping[str, Any]:
        """Return the row of this index, from 0, as values by column, None where unknown.

        Reading rows in order is fastest.
        """
        chunk, offset = divmod(index, ROWS)
        if chunk not in self._rows:  # only the last is kept, since rows are read in order
            self._rows.clear()
            self._rows[chunk] = self.rows.slice(chunk * ROWS, ROWS).to_pylist()
        return self._rows[chunk][offset]

    def _record(self, row: Mapping[str, Any]) -> Decision:
        messages: list[Message] = []
        for place in range(1, self.helpers + 1):
            sender = row[f"helper_{place}"]
            if sender is not None:
                values = [row[f"{name}_{place}"] for name in OF_MESSAGES if name != "helper"]
                messages.append(Message(sender, *values))
        plain = {name: row[name] for name in Decision.__struct_fields__ if name in COLUMNS}
        fused = tuple(row[f"fused_{action}"] for action in self.actions)
        return Decision(**{**plain, "fused": fused, "messages": tuple(messages)})

    def refuse_impossible(self) -> None:
        """Raise ValueError if a number is one that no run has, as `refuse_impossible` says."""
        for piece in self.pieces():
            for name in piece.rows.schema.names:
                refuse_impossible(name, piece.rows[name])

    def take(self, which: Any) -> "Decisions":
        places = of_buffer(np.asarray(which, dtype=np.int64), None, WHOLE)
        return Decisions(self.rows.take(places), self.actions, self.helpers)

    def replace(self, **columns: Any) -> "Decisions":
        table = self.table
        for name, values in columns.items():
            index = table.schema.get_field_index(name)
            table = table.set_column(index, name, _array(values, table.schema.field(name).type))
        return Decisions(table, self.actions, self.helpers)

    def rounded(self) -> "Decisions":
        decimals_by_name = {**DECIMALS, **dict.fromkeys(added_columns(), DECIMALS_ADDED)}
        decimals = {
            column: digits
            for name, digits in decimals_by_name.items()
            for column in self.rows.column_names
            if column == name or (name not in COLUMNS and column.startswith(f"{name}_"))
        }
        return self.replace(
            **{column: self[column].round(digits) for column, digits in decimals.items()}
        )

    def write(self, path: Path) -> None:
        """Write the table to a Parquet file at `path`; equal rows give equal bytes."""
        with replacing(path) as part:
            self._write(part)

    def encoded(self) -> bytes:
        if isinstance(self.rows, Packed) and self.rows.is_file:
            return bytes(self.rows.content)
        data = BytesIO()
        self._write(data)
        return data.getvalue()

    def _write(self, target: Path | BytesIO) -> None:
        _write(target, self.pieces(), schema(self.actions, self.helpers), self.unknown)

    @property
    def unknown(self) -> set[str]:
        """Return the names of the columns that a file need not have, and that are unknown here."""
        return {name for name in _optional() if self.rows[name].null_count == len(self)}

    @classmethod
    def packed(
        cls,
        pieces: "Iterable[Decisions]",
        like: Sequence["Decisions"],
        least: int | None = None,
    ) -> "Decisions":
        """Return decisions that come in pieces, one after another, packed as in their file.

        `like` are tables that together know the same columns. Each row group but the last has
        `least` rows or more, `ROW_GROUP` if that is None.
        """
        actions, helpers = like[0].actions, max(each.helpers for each in like)
        unknown = set.intersection(*(each.unknown for each in like))
        data, columns = BytesIO(), schema(actions, helpers)
        _write(data, pieces, columns, unknown, least)
        content = pa.py_buffer(data.getvalue())
        return cls(Packed.of(content, columns), actions, helpers)

    @classmethod
    def read(cls, path: Path, actions: Sequence[str], most: int | None = None) -> "Decisions":
        """Read decisions from a Parquet file that anybody may have written.

        `actions` names its meta-actions, in order. Raises OSError or ValueError if it is none,
        lacks a column, or has more than `most` rows or more bytes than its rows can need: a file of
        a few bytes may hold a thousand million rows.
        """
        content = _content(path)
        source = pq.ParquetFile(pa.BufferReader(content))
        n = source.metadata.num_rows
        if most is not None and n > most:
            raise ValueError(f"{n} rows; {most} is the most for its episodes")
        there = source.schema_arrow.names
        helpers = _helpers(there)
        expected = schema(actions, helpers)
        may_lack = {*formats.COLUMNS, *added_columns()}
        missing = [name for name in expected.names if name not in there]
        if lacking := [name for name in missing if re.sub(r"_\d+$", "", name) not in may_lack]:
            raise ValueError(f"it lacks {', '.join(lacking)}")
        wanted = {name for name in expected.names if name in there}
        if _bytes(source.metadata, wanted) > SLACK + len(there) * n * CELL:
            raise ValueError("it holds more bytes than decisions need")
        packed = Packed.of(content, expected)
        if n > ROW_GROUP:
            return_large_blocks()
        table = packed if n > ROW_GROUP else packed.whole()
        for name in expected.names:  # any of which may be broken
            n_unknown = table[name].null_count
            if n_unknown and name in NEVER_UNKNOWN:
                raise ValueError(f"{name} is unknown in some rows")
        return cls(table, tuple(actions), helpers)

    def frame(self) -> "pd.DataFrame":
        """Return the decisions as a pandas table: names are categories, flags may be unknown."""
        import pandas as pd

        return cast(
            "pd.DataFrame", self.table.to_pandas(types_mapper={FLAG: pd.BooleanDtype()}.get)
        )


@dataclass(frozen=True)
class DecisionFiles:
    """Hold decisions as Parquet files in order, which need not all fit into memory.

    `files` are the paths of tables of decisions, and `actions` the names of the actions that all of
    them have, in the order of every distribution.
    """

    files: Sequence[Path]  # what `Decisions.write` wrote
    actions: tuple[str, ...]  # the meta-actions of all of them

    def write(self, path: Path) -> None:
        """Write the decisions of all files to one Parquet file at `path`, one after another.

        Raises OSError or ValueError if a file is no table of decisions, or is broken.
        """
        columns = [set(pq.read_schema(arrow_file(file)).names) for file in self.files]
        helpers = max(_helpers(names) for names in columns)
        unknown = set(_optional()).difference(*columns)
        with replacing(path) as part:
            decisions = (Decisions.read(file, self.actions) for file in self.files)
            pieces = chain.from_iterable(each.pieces() for each in decisions)
            _write(part, pieces, schema(self.actions, helpers), unknown)


def refuse_impossible(name: str, column: pa.Array | pa.ChunkedArray) -> None:
    """Raise ValueError if a column of a table has a number that no run has: one beyond `MOST`.

    `name` is the column's; it may be of texts or flags, which have none.
    """
    if column.type in (WHOLE, NUMBER):
        numbers = _values(column, 0, np.int64 if column.type == WHOLE else np.float64)
        if ((numbers > MOST) | (numbers < -MOST)).any():
            raise ValueError(f"{name} is too large; allowed: up to {MOST}")


def _optional() -> list[str]:
    """Return the columns that a file lacks if all their values are unknown."""
    return [*OPTIONAL, *added_columns()]


def _bytes(described: pq.FileMetaData, names: Collection[str]) -> int:
    """Return the bytes that some columns of a Parquet file take without compression, as it says."""
    groups = (described.row_group(n) for n in range(described.num_row_groups))
    columns = (group.column(n) for group in groups for n in range(group.num_columns))
    return sum(
        column.total_uncompressed_size for column in columns if column.path_in_schema in names
    )


def _helpers(columns: Iterable[str]) -> int:
    return sum(name.startswith("helper_") for name in columns)


def _write(
    target: Path | BytesIO,
    parts: Iterable[Decisions],
    columns: pa.Schema,
    left_out: Collection[str],
    least: int | None = None,
) -> None:
    """Write decisions as one Parquet file with these columns but some;
    whole parts share a row group, which has `least` rows or more.
    """
    kinds = pa.schema([column for column in columns if column.name not in left_out])
    with pq.ParquetWriter(target, kinds, compression="zstd") as writer:
        group = [_empty(kinds)]
        for part in parts:
            group.append(part.table.drop_columns(list(left_out)))
            if sum(map(len, group)) >= (least or ROW_GROUP):
                writer.write_table(_row_group(group))
                group = [_empty(kinds)]
        if len(group) > 1:
            writer.write_table(_row_group(group))


def _row_group(tables: Sequence[pa.Table]) -> pa.Table:
    """Return tables as one, of the first one's columns;
    names are numbered in the order of the rows.
    """
    kinds = tables[0].schema
    table = pa.concat_tables(tables, promote_options="default").select(kinds.names).combine_chunks()
    columns = [
        column.cast(pa.string()).dictionary_encode() if column.type == LABEL else column
        for column in table.columns
    ]
    return pa.table(columns, schema=kinds)


def arrow_file(path: Path) -> pa.BufferReader:
    """Return a file's content for Arrow, in memory that Arrow owns.

    Arrow's threads let go of a file after the call that read it. Of an object of Python, bytes as
    well, they need the interpreter for that, and abort the process if it has begun to end.
    """
    return pa.BufferReader(_content(path))


def _content(path: Path) -> pa.Buffer:
    with opened(path, "rows") as file:
        content = pa.allocate_buffer(os.fstat(file.fileno()).st_size)
        size = file.readinto(memoryview(content).cast("B"))
    return content.slice(0, size)


def _empty(kinds: pa.Schema) -> pa.Table:
    return pa.table([pa.nulls(0, kind) for kind in kinds.types], schema=kinds)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    """Return an array or `Labels` as a column; null for NaN and for no label."""
    if isinstance(values, Labels):
        codes = of_buffer(values.codes.astype(np.int32), values.codes >= 0, pa.int32())
        texts = [name.encode() for name in values.names]
        ends = np.cumsum([0] + [len(text) for text in texts], dtype=np.int32)
        names = pa.StringArray.from_buffers(
            len(texts), pa.py_buffer(ends), pa.py_buffer(b"".join(texts))
        )
        return pa.DictionaryArray.from_arrays(codes, names)
    if kind == WHOLE:
        return of_buffer(values.astype(np.int64), None, kind)
    numbers = values.astype(np.float64)
    return of_buffer(numbers, ~np.isnan(numbers), NUMBER).cast(kind)


def _values(column: Any, unknown: float | int, kind: type) -> Any:
    """Return a column's values (n,), with `unknown` for nulls."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    mask, data = array.buffers()
    values: Any = np.frombuffer(data, kind, len(array), array.offset * np.dtype(kind).itemsize)
    if not array.null_count:
        return values
    end = array.offset + len(array)
    valid = np.unpackbits(np.frombuffer(mask, np.uint8), count=end, bitorder="little")[
        array.offset :
    ]
    return np.where(valid, values, unknown)
