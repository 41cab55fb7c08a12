"""Define families of scenarios, whose names begin with the family's and a colon.

An extension adds them (`adds={"families": ...}`), each with a reader of such names.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from harness.core.errors import UserError, printable
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Shipped

if TYPE_CHECKING:
    from harness.world.scenario import Scenario


@runtime_checkable
class Family(Protocol):
    """Read the names of scenarios that an extension makes by name, such as `env:merge-v0`."""

    heading: str  # above its options in the help of commands
    # options of commands that take a scenario, which name one of the family instead, and their
    # help; the first is needed where another is typed
    options: Mapping[str, str]

    def named(self, typed: Mapping[str, str]) -> str:
        """Return the scenario's name by what is typed for some of the options.

        Raises UserError for what names none.
        """
        ...

    def scenario(self, name: str) -> "Scenario":
        """Return the scenario of a name. Raises UserError if there is none."""
        ...

    def split(self, text: str) -> tuple[str, str | None]:
        """Split a text into the name and settings such as `decisions=5`; None without any."""
        ...

    def joined(self, name: str, settings: Sequence[str]) -> str:
        """Add settings to a name; the inverse of `split`."""
        ...

    def allow(self, name: str) -> str | None:
        """Let a name that the user typed open what it needs, such as a module.

        A name from a file is never given to this function. Returns what other commands need for
        it, as a sentence; None if that is nothing.
        """
        ...


FAMILIES = Shipped[Family]("swarmdrive.families", Family, {})  # of none but extensions that ship


def family_of(text: str) -> Family | None:
    """Return the family of a scenario's name; None for a scenario of no family.

    Raises UserError if its extension is not installed.
    """
    name, colon, _ = text.partition(":")
    if not colon:
        return None
    if name in FAMILIES:
        return FAMILIES[name]
    if owner := owner_of_plugin("families", name):
        raise UserError(f"scenario {printable(text, 80)} is {part_of(owner)}")
    return None
