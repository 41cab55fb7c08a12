"""Find schedules by name: formulas, files `schedules/*.toml` and those that other packages add.

A file holds a learnt schedule and what it was learnt from; `harness study schedule learn` writes it. A
package adds a schedule by an entry point in the group `swarmdrive.schedules`.
"""

from functools import lru_cache
from typing import Any

from harness.coordination.learnt import Learnt, Stated
from harness.coordination.scheduling import FORMULAS, Schedule
from harness.core.config import convert, toml
from harness.core.errors import printable
from harness.core.files import sha256_file
from harness.core.plugins import FilesAndPlugins


class Schedules(FilesAndPlugins[Schedule]):
    """All schedules, by name."""

    folder = "schedules"

    def read(self, file: Any) -> Schedule:
        """Return the learnt schedule in a file."""
        return _read(file)

    def file_sha256(self, name: str) -> str | None:
        """Return the digest of the file that holds a schedule; None if it is not in a file."""
        file = self.file(name)
        return sha256_file(file) if file else None


@lru_cache(maxsize=64)
def _read(path: Any) -> Learnt:
    where = f"schedule file {printable(path)}"
    return convert(toml(path, where), Stated, where).schedule(where)


SCHEDULES = Schedules("swarmdrive.schedules", Schedule, FORMULAS)
