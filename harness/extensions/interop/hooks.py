"""Hooks that follow a run while it goes, of which a user chooses some by name.

A package adds one by an entry point in the group `swarmdrive.hooks`. A hook that fails, ends the
program or hangs costs a run nothing but time: one line on stderr says so, and it follows that run
no further.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import contextmanager, redirect_stdout
from copy import deepcopy
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from harness.core import extras, process
from harness.core.errors import one_line, printable, unknown
from harness.core.plugins import Plugins
from harness.core.strangers import strangers

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated

# environment variable: names, with commas, where a command names none
CHOSEN = "SWARMDRIVE_TRACKERS"
PATIENCE_S = 20.0  # within which a hook must come back: its server may be away
SENDING_S = 120.0  # the same at the end of a run: it may send a page over a slow line
STOPPED_S = 10.0  # the same where the run was stopped, and somebody waits
SAID_S = 3.0  # after which it is said that a hook is waited for


@runtime_checkable
class Hook(Protocol):
    """Describe a plug-in that follows a command's runs, such as an experiment tracker.

    For each run, one after the other, `begin` is called, then `answered` several times, then `end`;
    all may raise anything. One that needs modules of an optional extra
    (`harness.core.extras.OPTIONAL`) states these as its `needs`.
    """

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Take note that a run begins, before its first answer is counted.

        `folder` is the run's, and `settings` are its settings by name, plain values as in its
        `run.json`.
        """
        ...

    def answered(self, total: int) -> None:
        """Take note of how many answers the run has now, those kept from before included.

        In closed loop, where the model drives, they are episodes.
        """
        ...

    def end(self, done: "Evaluated | None") -> None:
        """Take note that the run is over.

        `done` has the finished run: its folder (`out`), manifest and scores; it is None if the run
        was stopped.
        """
        ...


HOOKS: Plugins[Hook] = Plugins("swarmdrive.hooks", Hook, {})


def chosen(names: Iterable[str]) -> dict[str, Hook]:
    """Return the hooks that are to follow a command's runs, such as trackers, by name.

    `names` are those typed; if empty, those in the variable `SWARMDRIVE_TRACKERS` are taken. Raises
    UserError if there is no such hook, or its package is not installed.
    """
    typed, where, hint = tuple(names), "--tracker ", ""
    if not typed:
        typed = tuple(filter(None, map(str.strip, os.environ.get(CHOSEN, "").split(","))))
        where, hint = f"{CHOSEN}=", f"; it stands in {CHOSEN}"
    for name in typed:
        if name not in HOOKS:
            raise unknown("tracker", name, HOOKS, hint)
    hooks = {name: HOOKS[name] for name in typed}
    for name, hook in hooks.items():
        needs = getattr(hook, "needs", ())
        if isinstance(needs, tuple):  # a package's may be anything
            extras.need(
                f"{where}{name}", *(module for module in extras.OPTIONAL if module in needs)
            )
    return hooks


class _Caller:
    """A thread that calls one hook, in the order in which it is asked to,
    since hooks keep things by thread.

    A hook that hangs leaves its thread, which ends with the program.
    """

    def __init__(self, name: str, hook: Hook) -> None:
        self._what, self._hook = f"tracker {printable(name)}", hook
        self._calls: SimpleQueue[tuple[Future[None], str, tuple[Any, ...]]] = SimpleQueue()
        Thread(target=self._work, daemon=True).start()

    def call(self, method: str, arguments: tuple[Any, ...], patience_s: float) -> None:
        """Call a method.

        Raises what it raises, and TimeoutError if it takes longer than `patience_s`. An interrupt
        that comes meanwhile gets a note: a hook can send it as well as Ctrl-C, and nothing tells
        them apart.
        """
        try:
            with process.streams_kept(self._what):
                self._call(method, arguments, patience_s)
        except KeyboardInterrupt as stop:
            stop.add_note(f"it came during {method} of {self._what}")
            raise

    def _call(self, method: str, arguments: tuple[Any, ...], patience_s: float) -> None:
        done, here = Future[None](), os.getcwd()
        self._calls.put((done, method, arguments))
        if not wait([done], min(SAID_S, patience_s)).done and patience_s > SAID_S:
            print(f"harness: waiting for {self._what}, {patience_s:g} s at most", file=sys.stderr)
        if not wait([done], max(patience_s - SAID_S, 0.0)).done:
            os.chdir(here)  # which it may have left
            process.give_up()
            raise TimeoutError(f"its {method} takes longer than {patience_s:g} s")
        done.result()

    def _work(self) -> None:
        while True:
            done, method, arguments = self._calls.get()
            try:
                with strangers(self._what):
                    getattr(self._hook, method)(*arguments)
            except Exception as error:  # a stranger's code
                done.set_exception(error)
            else:
                done.set_result(None)


class Followers:
    """Call hooks (plug-ins such as trackers) during one run, from its first new answer to its end.

    One that fails or hangs is reported on stderr and called no more. If there is no new answer, the
    run begins for them when it ends.
    """

    def __init__(
        self, hooks: Mapping[str, Hook], folder: Path, settings: Mapping[str, Any]
    ) -> None:
        self._callers = {name: _Caller(name, hook) for name, hook in hooks.items()}
        self._begun, self._total = False, 0
        self._folder, self._settings = folder, settings

    def counting(self, progress: Callable[[int], None]) -> Callable[[int], None]:
        """Return a function to call with the number of answers that are new.

        It calls `progress` with that number, and the hooks (plug-ins that follow the run) with the
        total so far.
        """

        def count(new: int) -> None:
            progress(new)
            self._begin()
            self._total += new
            self._call("answered", self._total)

        return count if self._callers else progress

    def end(self, done: "Evaluated | None") -> None:
        if done:
            self._begin()
        if self._begun:
            self._call("end", done, patience_s=SENDING_S if done else STOPPED_S)

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            self._call("begin", self._folder, self._settings)

    def _call(self, method: str, *arguments: Any, patience_s: float | None = None) -> None:
        for name, caller in list(self._callers.items()):
            try:
                with redirect_stdout(sys.stderr):  # what a command prints may be read by a program
                    caller.call(method, deepcopy(arguments), patience_s or PATIENCE_S)
            except Exception as error:  # a stranger's code
                who = f"tracker {printable(name)}"
                reason = one_line(error).removeprefix(f"{who} ") or type(error).__name__
                print(f"harness: {who}: {reason}; the run goes on without it", file=sys.stderr)
                del self._callers[name]


@contextmanager
def following(
    hooks: Mapping[str, Hook], folder: Path, settings: Mapping[str, Any]
) -> Iterator[Followers]:
    """Enter a context in which hooks, plug-ins such as trackers, follow a run.

    They are told if it raises. `hooks` are by name, `folder` is the run's, and `settings` are its
    settings by name, as in its `run.json`. Call `end` of the object that is entered with the
    finished run.
    """
    followers = Followers(hooks, folder, settings)
    try:
        yield followers
    except BaseException:
        followers.end(None)
        raise
