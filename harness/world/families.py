"""Define families of scenarios, whose names begin with the family's and a colon.

An extension adds them (`adds={"families": ...}`), each with a reader of such names.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from harness.core.errors import UserError, printable
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Shipped

if TYPE_CHECKING:
    from harness.world.scenario import Scenario


@runtime_checkable
class Family(Protocol):
    """Make scenarios by name: an extension's reader of names such as `env:merge-v0`.

    What stands before the colon is the family's own name. `options` are options of a command by
    which users can describe such a scenario in place of its name: the help text of each, by its
    name, such as that of a module to import. `heading` stands above them in the command's help.
    """

    heading: str  # text above the family's options in the help of commands
    # name and help of each option by which commands that take a scenario name one of the family
    # instead; the first is needed where another is typed
    options: Mapping[str, str]

    def named(self, typed: Mapping[str, str]) -> str:
        """Return the name of the scenario that options of a command describe.

        `typed` has the options of `options` that a user typed, by name, with their values. Raises
        UserError if they name none.
        """
        ...

    def scenario(self, name: str) -> "Scenario":
        """Make the scenario of a name such as `env:merge-v0`. Raises UserError if there is none."""
        ...

    def typed(self, text: str, folder: str) -> list[str]:
        """Return the words by which a command names a scenario of a dataset: options, or its text.

        `text` is its name with or without settings, and the dataset lies in `folder`.
        """
        ...

    def split(self, text: str) -> tuple[str, str | None]:
        """Split the text of a scenario into its name and its settings, such as `decisions=5`.

        The settings are one text, None without any.
        """
        ...

    def joined(self, name: str, settings: Sequence[str]) -> str:
        """Return a scenario's text: its name with settings, each such as `decisions=5`, added.

        `split` takes such a text apart again.
        """
        ...

    def allow(self, name: str) -> str | None:
        """Let a scenario that the user typed open what its name needs, such as a module.

        It is called before `scenario`, and never with a name from a file, which must open nothing.
        Returns a sentence on what other commands need for this scenario; None if that is nothing.
        """
        ...

    def kept_in(self, name: str, folder: Path) -> None:
        """Take note that the folder of a dataset may hold what a scenario of it is made from.

        It is called with the `name` that the dataset states before `scenario` is, also for the
        datasets of strangers: what lies in `folder` may be used only if it has the digest that the
        name states. Worker processes must find it, too.
        """
        ...


FAMILIES = Shipped[Family]("swarmdrive.families", Family, {})  # of none but extensions that ship


def family_of(text: str) -> Family | None:
    """Return what makes scenarios of names such as `env:merge-v0`; None for other names.

    It is a family, an extension's reader of such names; `text` is the name, with or without
    settings. Raises UserError if the family is of an extension that is not installed.
    """
    name, colon, _ = text.partition(":")
    if not colon:
        return None
    if name in FAMILIES:
        return FAMILIES[name]
    if owner := owner_of_plugin("families", name):
        raise UserError(f"scenario {printable(text, 80)} is {part_of(owner)}")
    return None


def keep(text: str, folder: Path) -> None:
    """Let the family of a scenario know the folder of a dataset that states the scenario's name.

    `text` is that name; of scenarios that are no family's nothing is kept.
    """
    if family := family_of(text):
        family.kept_in(text, folder)
