"""Formats of other programs that extensions add to `harness run export`, each an option of its own.

An extension adds one by `adds={"exports": {"name": "module:OBJECT"}}`; `--name FILE` writes it.
"""

from pathlib import Path
from typing import Protocol, runtime_checkable

from harness.core.plugins import Plugins
from harness.runs.folder import Run


@runtime_checkable
class Export(Protocol):
    """What writes a run as a file of another program."""

    help: str  # of the option
    doing: str  # what is said while it writes
    needs: tuple[str, ...]  # modules of extras without which it cannot write: `harness.core.extras.OPTIONAL`

    def write(self, run: Run, file: Path, dataset: Path | None) -> Path:
        """Write a file and return it; `dataset` is the folder of the run's, if it is stated."""
        ...


EXPORTS: Plugins[Export] = Plugins("swarmdrive.exports", Export, {})
