"""Options of a command that no run keeps: what follows its runs, and what may stop them.

Each is an extension's.

One that ships adds it by `adds={"options": {NAME: "module:OPTION"}}`. It is typed
`--NAME`, with `-` for `_`, and `harness.run` takes it as `NAME`.
"""

from abc import ABC
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from harness.core.plugins import Shipped

if TYPE_CHECKING:
    from harness.backends.base import Backend
    from harness.backends.card import Card
    from harness.core.parallel import Workers
    from harness.evaluate.lifecycle import Evaluated
    from harness.evaluate.spec import Spec


class Follower(Protocol):
    """Describe what an extension is told of one run while it goes, such as to a tracker."""

    def counting(self, progress: Callable[[int], None]) -> Callable[[int], None]:
        """Return a function of a number of new answers that calls `progress`, too."""
        ...

    def end(self, done: "Evaluated") -> None:
        """Take note that the run is finished, with its page."""
        ...


# Enters a context with what follows a run, by its folder and its settings as in its `run.json`; if
# the context is left by an error, the run was stopped.
Follow = Callable[[Path, Mapping[str, Any]], AbstractContextManager[Follower]]
# Returns a model's backend, wrapped so that it may refuse to ask (by Unanswered); it changes no
# answer. It goes to other processes of this machine.
Guard = Callable[["Card", "Backend"], "Backend"]


class CommandOption(ABC):
    """Describe an option of `harness eval` and `harness drive` that changes nothing of a run.

    It may tell others of the runs while they go (`follow`), or stop them (`guard`); a base class.
    """

    kind: ClassVar[Any]  # of its value: str, int, float, bool or list[str]
    help: ClassVar[str]  # a sentence for people
    metavar: ClassVar[str]  # what help calls the value
    follows: ClassVar[bool] = False  # whether it follows whole runs

    def follow(self, value: Any, instead: str) -> Follow | None:
        """Return what follows each run of the command; None for nothing.

        `value` is what is typed, None where nothing is. `instead` names what the command makes in
        place of whole runs, such as a shard, which nothing follows; it is empty for runs. Raises
        UserError for a value that is not allowed.
        """
        return None

    def guard(
        self, value: Any, specs: "Sequence[Spec]", workers: "Workers"
    ) -> AbstractContextManager[Guard | None]:
        """Enter a context with what may refuse to ask in the command's evaluations; None for
        nothing.

        `value` is as in `follow`. Raises UserError for a value that is not allowed.
        """
        return nullcontext()


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


@contextmanager
def guarded(
    typed: Mapping[str, Any], specs: "Sequence[Spec]", workers: "Workers"
) -> "Iterator[list[Spec]]":
    """Enter a context with a command's evaluations, guarded by what is typed.

    Raises UserError for a value that is not allowed.
    """
    guards = list[Guard]()
    with ExitStack() as stack:
        for name, option in OPTIONS.usable().items():
            guard = stack.enter_context(option.guard(typed.get(name), specs, workers))
            if guard:
                guards.append(guard)
        yield [replace(spec, guards=tuple(guards)) for spec in specs]
