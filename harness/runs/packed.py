"""Tables that stay in the bytes of their Parquet file: what is read of them is decoded then."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.core.arrays import Ints


@dataclass(frozen=True)
class Packed:
    """Hold a table of n rows as its Parquet file, some bytes a row, and decode what is asked for.

    It has the methods of `pyarrow.Table` by which decisions are read, so that it can stand in the
    place of one: a column is decoded alone, and rows in groups, which are the file's row groups.
    The last group decoded is kept, since rows are read in order.
    """

    content: pa.Buffer  # the whole Parquet file
    metadata: pq.FileMetaData  # what it says of its row groups
    schema: pa.Schema  # names and types of the columns; one that the file lacks is null
    groups: Sequence[int]  # the places of the row groups in the file
    # the rows of the group that was decoded last, by its place in the file
    _last: dict[int, pa.Table] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, content: pa.Buffer, schema: pa.Schema) -> "Packed":
        """Return the table in a file's content, with the columns of `schema`."""
        metadata = pq.ParquetFile(pa.BufferReader(content)).metadata
        return cls(content, metadata, schema, range(metadata.num_row_groups))

    @property
    def column_names(self) -> list[str]:
        return list(self.schema.names)

    @property
    def is_file(self) -> bool:
        """Return whether the content has these rows and columns alone."""
        names = [name for name in self.metadata.schema.names if name in self.schema.names]
        groups, columns = self.metadata.num_row_groups, self.metadata.num_columns
        return bool(len(self.groups) == groups and len(names) == columns)

    @property
    def _ends(self) -> Ints:
        """Return at which row each group begins, and the last one ends, (groups + 1,)."""
        sizes = [self.metadata.row_group(group).num_rows for group in self.groups]
        return np.cumsum([0, *sizes])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, name: str) -> pa.ChunkedArray:
        return self.select([name]).whole()[name]

    def select(self, names: Sequence[str]) -> "Packed":
        schema = pa.schema([self.schema.field(name) for name in names])
        return replace(self, schema=schema, _last={})

    def whole(self) -> pa.Table:
        """Return the table decoded; names are numbered alike in all of its rows."""
        file = pq.ParquetFile(pa.BufferReader(self.content), metadata=self.metadata)
        there = set(file.schema_arrow.names)
        names = [name for name in self.schema.names if name in there]
        table = file.read_row_groups(list(self.groups), columns=names)
        for column in self.schema:
            if column.name not in there:
                table = table.append_column(column, pa.nulls(len(self), column.type))
        return table.select(self.schema.names).cast(self.schema).unify_dictionaries()

    def pieces(self) -> "Iterator[Packed]":
        """Yield the table's groups of rows, in order, as tables of their own."""
        for group in self.groups:
            yield replace(self, groups=(group,), _last={})

    def slice(self, start: int, length: int) -> pa.Table:
        return self.take(_indices(np.arange(start, min(start + length, len(self)))))

    def take(self, places: pa.Array) -> pa.Table:
        """Return the rows (m,) of these indices, whole numbers of 64 bits, in this order."""
        rows = np.frombuffer(places.buffers()[1], np.int64)
        order = np.argsort(rows, kind="stable")
        ends = self._ends
        bounds = np.searchsorted(rows[order], ends)
        parts = [self.schema.empty_table()]
        for place, group in enumerate(self.groups):
            of_group = order[bounds[place] : bounds[place + 1]]
            if len(of_group):
                parts.append(self._group(group).take(_indices(rows[of_group] - ends[place])))
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return pa.concat_tables(parts).unify_dictionaries().take(_indices(back))

    def to_batches(self, most: int) -> Iterator[pa.RecordBatch]:
        for piece in self.pieces():
            yield from piece.whole().to_batches(most)

    def _group(self, group: int) -> pa.Table:
        if group not in self._last:
            self._last.clear()
            self._last[group] = replace(self, groups=(group,)).whole()
        return self._last[group]


# pyarrow loads pandas when it converts a foreign array to its own or back; going by buffers avoids
# that.


def _indices(rows: Ints) -> pa.Array:
    return of_buffer(rows.astype(np.int64), None, pa.int64())


def of_buffer(values: Any, valid: Any, kind: pa.DataType) -> pa.Array:
    """Return an array (n,) as a column of its type `kind`, null where not `valid`, (n,) or None."""
    mask = None if valid is None else pa.py_buffer(np.packbits(valid, bitorder="little"))
    return pa.Array.from_buffers(
        kind, len(values), [mask, pa.py_buffer(np.ascontiguousarray(values))]
    )
