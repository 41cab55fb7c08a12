"""What the families share whose names have a digest of files, which lie in folders."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

DIGITS = 12  # of the files' digest, in a scenario's name


@dataclass(frozen=True)
class Folders:
    """List the folders that may hold such files, here and in worker processes."""

    variable: str  # name of the environment variable that has them

    @property
    def listed(self) -> tuple[str, ...]:
        paths = os.environ.get(self.variable, "").split(os.pathsep)
        return tuple(path for path in paths if path)

    def remember(self, folder: Path, is_first: bool = False) -> None:
        """Look in a folder, too: before the others, or after them."""
        paths = list(self.listed)
        if str(folder) not in paths:
            paths.insert(0 if is_first else len(paths), str(folder))
            os.environ[self.variable] = os.pathsep.join(paths)


def digest_in(name: str) -> str:
    """Return the digits that a name such as `crossing@0123456789ab` has; empty if it has none."""
    digest = name.partition("@")[2]
    return digest if len(digest) == DIGITS else ""


class ByDigest:
    """Read names such as `recording:crossing@0123456789ab:decisions=2`; a base class of families.

    Methods are those of `Family`.
    """

    def split(self, text: str) -> tuple[str, str | None]:
        name, _, settings = text.rpartition(":")
        return (name, settings) if "=" in settings else (text, None)

    def joined(self, name: str, settings: Sequence[str]) -> str:
        return ":".join([name, *([",".join(settings)] if settings else [])])

    def typed(self, text: str, folder: str) -> list[str]:
        return [text]

    def allow(self, name: str) -> str | None:
        return None  # a dataset has the files of its scenario
