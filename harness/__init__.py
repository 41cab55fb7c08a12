"""SwarmDrive Harness: evaluates prompts, parsing and coordination in cooperative driving."""

from typing import TYPE_CHECKING

from harness.core.errors import UserError

if TYPE_CHECKING:
    from os import PathLike

    from harness.runs.tables import Tables

__all__ = ["UserError", "load"]
__version__ = "0.2.0"


def load(run: "str | PathLike[str]") -> "Tables":
    """A run as pandas tables: `summary`, `episodes`, `decisions`, `answers`, and its `config`.

    Args:
        run: folder made by `harness eval` or `harness drive`.

    Raises:
        UserError: it is no finished run, or a file of it is broken.
    """
    from pathlib import Path

    from harness.runs.tables import load as read

    return read(Path(run))
