"""Options of a command that no run keeps, such as what follows its runs; each is an extension's.

An extension that ships adds one by `adds={"options": {NAME: "module:OPTION"}}`. It is typed
`--NAME`, with `-` for `_`, and `harness.run` takes it as `NAME`.
"""

from abc import ABC
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from harness.core.plugins import Shipped

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated


class Follower(Protocol):
    """Describe what is told of one run while it goes."""

    def counting(self, progress: Callable[[int], None]) -> Callable[[int], None]:
        """Return a function of a number of new answers that calls `progress`, too."""
        ...

    def end(self, done: "Evaluated") -> None:
        """Take note that the run is finished, with its page."""
        ...


# Enters a context with what follows a run, by its folder and its settings as in its `run.json`; if
# the context is left by an error, the run was stopped.
Follow = Callable[[Path, Mapping[str, Any]], AbstractContextManager[Follower]]


class CommandOption(ABC):
    """An option of `harness eval` and `harness drive` that changes nothing of a run."""

    kind: ClassVar[Any]  # of its value: str, int, float, bool or list[str]
    help: ClassVar[str]  # a sentence for people
    metavar: ClassVar[str]  # what help calls the value

    def follow(self, value: Any, instead: str) -> Follow | None:
        """Return what follows each run of the command; None for nothing.

        `value` is what is typed, None where nothing is. `instead` names what the command makes in
        place of whole runs, such as a shard, which nothing follows; it is empty for runs. Raises
        UserError for a value that is not allowed.
        """
        return None


OPTIONS = Shipped[CommandOption]("swarmdrive.options", CommandOption, {})


def follows(typed: Mapping[str, Any], instead: str = "") -> Sequence[Follow]:
    """Return what follows each run of a command, by what is typed for options of extensions.

    `instead` is as in `CommandOption.follow`. Raises UserError for a value that is not allowed.
    """
    each_follows = []
    for name, option in OPTIONS.usable().items():
        if follow := option.follow(typed.get(name), instead):
            each_follows.append(follow)
    return each_follows
