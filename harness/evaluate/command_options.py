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
    """Describe what follows one run while it goes, such as a tracker's record of experiments.

    Extensions add these.
    """

    def counting(self, progress: Callable[[int], None]) -> Callable[[int], None]:
        """Return a function that is told how many answers a run has got, to count them elsewhere.

        It takes a number of new answers and also calls `progress` with it, which is what the run
        would call without this extension.
        """
        ...

    def end(self, done: "Evaluated") -> None:
        """Take note that the run is finished and has its page; `done` has its results.

        They are its folder, manifest (settings and origin) and scores.
        """
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
    `kind` is the type of its value, `metavar` what the help calls it, and `follows` says whether it
    follows whole runs.
    """

    kind: ClassVar[Any]  # of its value: str, int, float, bool or list[str]
    help: ClassVar[str]  # a sentence for people
    metavar: ClassVar[str]  # what help calls the value
    follows: ClassVar[bool] = False  # whether it follows whole runs

    def follow(self, value: Any, instead: str) -> Follow | None:
        """Return what is to be told of each run of the command, a function; None for nothing.

        The function takes the run's folder and its settings as in `run.json`, and returns a context
        with a `Follower`; if the context is left by an error, the run was stopped. `value` is what
        is typed, None where nothing is. `instead` names what the command makes in place of whole
        runs, such as a shard (a part of one), of which nothing is told; it is empty for runs.
        Raises UserError for a value that is not allowed.
        """
        return None

    def guard(
        self, value: Any, specs: "Sequence[Spec]", workers: "Workers"
    ) -> AbstractContextManager[Guard | None]:
        """Enter a context with a function that may stop the command from asking models, or None.

        It may limit the cost so. The function takes a model's card and backend, and returns the
        backend wrapped so that it may refuse to ask, by Unanswered. `value` is what is typed, None
        where nothing is; `specs` are the evaluations, and `workers` what runs them. Raises
        UserError for a value that is not allowed.
        """
        return nullcontext()


OPTIONS = Shipped[CommandOption]("swarmdrive.options", CommandOption, {})


def follows(typed: Mapping[str, Any], instead: str = "") -> Sequence[Follow]:
    """Return what is to be told of each run of a command, a function for each option typed.

    Such is a tracker's. A function takes the run's folder and its settings as in `run.json`, and
    returns a context with a `Follower`. `typed` has the values of extensions' options by name.
    `instead` names what the command makes in place of whole runs, such as a shard (a part of one);
    it is empty for runs. Raises UserError for a value that is not allowed.
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
    """Enter a context with a command's evaluations, changed so that extensions may stop asking.

    Such an extension may limit the cost. `typed` has the values of extensions' options by name, and
    `workers` is what runs the evaluations `specs`. Raises UserError for a value that is not
    allowed.
    """
    guards = list[Guard]()
    with ExitStack() as stack:
        for name, option in OPTIONS.usable().items():
            guard = stack.enter_context(option.guard(typed.get(name), specs, workers))
            if guard:
                guards.append(guard)
        yield [replace(spec, guards=tuple(guards)) for spec in specs]
