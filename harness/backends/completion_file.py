"""Completions in a SQLite file, by key: many processes read and write it, and it may vanish at any time."""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from harness.backends.base import Completion

# What a completion has of its own asking, and not of its answer.
_NOT_KEPT = ("request_id", "seconds", "error", "retries", "cached")
_KEPT = tuple(f.name for f in fields(Completion) if f.name not in _NOT_KEPT)
_WAIT_S = 30.0  # for another process that is writing
_AT_ONCE = 500  # keys of one look-up; SQLite has a limit
_TABLE = "CREATE TABLE IF NOT EXISTS completions (key TEXT PRIMARY KEY, answer TEXT NOT NULL) WITHOUT ROWID"


class CompletionFile:
    """The file. It is opened anew for every call, so that one that was deleted is simply empty again.

    Both methods raise sqlite3.Error or OSError where it cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def find(self, keys: Sequence[str]) -> dict[str, Completion]:
        """The completions that are there, by key. They have no seconds, and their request's id is empty."""
        rows: list[tuple[str, str]] = []
        with self._open() as file:
            for start in range(0, len(keys), _AT_ONCE):
                some = keys[start : start + _AT_ONCE]
                marks = ",".join("?" * len(some))
                rows += file.execute(f"SELECT key, answer FROM completions WHERE key IN ({marks})", some)
        try:
            return {key: _completion(json.loads(answer)) for key, answer in rows}
        except (ValueError, TypeError) as error:
            raise sqlite3.DatabaseError(f"an answer is damaged: {error}") from None

    def add(self, completions: Mapping[str, Completion]) -> None:
        """Keep completions by key; one that is there already stays."""
        # ASCII, since a completion may hold a lone surrogate, which no file takes.
        rows = [(key, json.dumps({k: getattr(c, k) for k in _KEPT})) for key, c in completions.items()]
        with self._open() as file:
            file.execute("BEGIN IMMEDIATE")
            file.executemany("INSERT OR IGNORE INTO completions VALUES (?, ?)", rows)
            file.execute("COMMIT")

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(self.path, timeout=_WAIT_S, isolation_level=None)) as file:
            file.execute("PRAGMA journal_mode = WAL")
            file.execute("PRAGMA synchronous = NORMAL")
            file.execute(_TABLE)
            yield file


def _completion(kept: dict[str, Any]) -> Completion:
    return Completion(request_id="", seconds=None, cached=True, **kept)
