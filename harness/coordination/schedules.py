"""Schedules by name: formulas, files `schedules/*.toml`, shipped and a project's, and what packages add.

A file holds a learnt schedule and what it was learnt from; `harness schedule learn` writes it. A package adds
a schedule by an entry point in the group `swarmdrive.schedules`.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

from harness.coordination.learnt import Learnt, Stated
from harness.coordination.scheduling import FORMULAS, Schedule
from harness.core.config import convert, toml
from harness.core.errors import printable
from harness.core.files import sha256_file
from harness.core.plugins import Plugins
from harness.core.resources import entries, find


class Schedules(Plugins[Schedule]):
    """All schedules."""

    def __getitem__(self, name: str) -> Schedule:
        """Raises KeyError for an unknown name and UserError for a file or a package that does not work."""
        if name not in self._loaded and name in _files():
            return _read(find("schedules", f"{name}.toml"))
        return super().__getitem__(name)

    def file_sha256(self, name: str) -> str | None:
        """Digest of the file that holds a schedule; None for one that no file holds."""
        return sha256_file(find("schedules", f"{name}.toml")) if name in _files() else None

    def __iter__(self) -> Iterator[str]:
        return iter({**dict.fromkeys(self.built_in), **dict.fromkeys(_files()), **self._entries()})

    def __len__(self) -> int:
        return len(list(iter(self)))


def _files() -> list[str]:
    return [path.stem for path in entries("schedules", "*.toml")]


@lru_cache(maxsize=64)
def _read(path: Any) -> Learnt:
    where = f"schedule file {printable(path)}"
    return convert(toml(path, where), Stated, where).schedule(where)


SCHEDULES = Schedules("swarmdrive.schedules", Schedule, FORMULAS)
