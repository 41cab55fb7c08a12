"""Formats of other programs that extensions add to `harness run export`, each an option of its own.

An extension adds one by `adds={"exports": {"name": "module:OBJECT"}}`; `--name FILE` writes it. Its
attribute `options`, if it has one, is a table of further options by name.

One that ships adds a file to `--csv` by `adds={"csv_rows": {"name": "module:ROWS"}}`: `name.csv`,
where the run has any such rows.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, runtime_checkable

from harness.core.plugins import Plugins, Shipped, of_type, tuple_of
from harness.runs.folder import Run


@dataclass(frozen=True)
class Option:
    """Describe a further command-line option of an export format.

    `kind` is the type of what is typed: `bool` for a switch, or `float`. `refusal` takes the value
    and the command-line option of the format, and returns why the value is refused, or None.
    Formats that share an option hold the same object.
    """

    kind: type  # what is typed: `bool` for a switch, or `float`
    help: str  # its help
    # returns why a value is refused, or None, given the value and the command-line option of the
    # format that is exported
    refusal: Callable[[Any, str], str | None]


@runtime_checkable
class Export(Protocol):
    """Describe a format that an extension adds, in which a run is written for another program.

    `help` is the help of its command-line option, `doing` what is said while it writes, and `needs`
    the names of the optional modules without which it cannot.
    """

    help: str  # the help of its command-line option
    doing: str  # what is said while it writes, such as `writing chats`
    # names of the optional modules without which it cannot write, of
    # `harness.core.extras.OPTIONAL`
    needs: tuple[str, ...]

    def write(self, run: Run, file: Path, dataset: Path | None, **options: Any) -> Path:
        """Write a run to a file in this format, and return the file.

        `dataset` is the folder of the run's dataset, if the user named one; `options` holds the
        values of the format's further options by name, with `_` for `-`.
        """
        ...


def _are_options(value: Any) -> bool:
    options = value.values() if isinstance(value, Mapping) else [value]
    return all(isinstance(option, Option) for option in options)


class Exports(Plugins[Export]):
    """Hold the export formats by name, such as those that write a run for another program.

    `stated` has a rule for each attribute of a format that a package adds: a test of its value, and
    words for what is allowed.
    """

    # what packages' formats must have, by attribute: a test of its value, and words for what is
    # allowed
    stated: ClassVar = {
        "help": of_type(str),
        "doing": of_type(str),
        "needs": tuple_of(of_type(str)),
        "options": (_are_options, "a table of Option"),
    }


EXPORTS = Exports("swarmdrive.exports", Export, {})


class Rows(ABC):
    """Give the rows of a further file of `harness run export --csv`; a base class.

    `columns` are the names in its first line.
    """

    columns: ClassVar[tuple[str, ...]]  # the names in the first line

    @abstractmethod
    def of(self, run: Run) -> list[Sequence[object]]:
        """Return the rows that a run has, a cell for each column; if it has none, no file is made.

        Raises UserError if what they are read from is broken.
        """


ROWS = Shipped[Rows]("swarmdrive.csv_rows", Rows, {})


def options_of(format: Export) -> Mapping[str, Option]:
    """Return the further command-line options of an export format, by name.

    It is empty if the format has none.
    """
    options: Mapping[str, Option] = getattr(format, "options", MappingProxyType({}))
    return options
