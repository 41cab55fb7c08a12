"""The door to the code of packages: it runs between lines that it can neither end nor move the
program past.

An error of a package is raised as it is, for the caller to word. Two things are no errors, and not
a package's to do: to end the program, as `sys.exit` does, and to leave it in another working
folder, from which relative paths lead elsewhere. Code that does not come back nothing can stop: a
line says what the command waits for.
"""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.process import Stop

PATIENCE_S = 20.0  # after which a line says what a command waits for
LOOK_S = 1.0  # between two looks at what runs
_STOPS = (signal.SIGINT, signal.SIGTERM)  # by which a user ends a command
_calls: dict[object, tuple[str, float, float]] = {}  # what runs now, since when, for how long
_slow_calls: set[str] = set()
_watchers: set[int] = set()  # processes with a thread that watches


@contextmanager
def watched(what: str, patience_s: float | None = None) -> Iterator[None]:
    """Enter a context that names code which takes long, once, on stderr.

    So the user knows what he waits for. `what` names the code, and `patience_s` is how many seconds
    it may take before that; `PATIENCE_S` by default. The code is not stopped.
    """
    call = object()
    _calls[call] = what, time.monotonic(), patience_s or PATIENCE_S
    if os.getpid() not in _watchers:
        _watchers.add(os.getpid())
        threading.Thread(target=_watch, daemon=True).start()
    try:
        yield
    finally:
        del _calls[call]


def _watch() -> None:
    while True:
        time.sleep(LOOK_S)
        for what, since_s, patience_s in list(_calls.values()):
            if what not in _slow_calls and time.monotonic() - since_s > patience_s:
                _slow_calls.add(what)
                line = f"{what} has not come back for {patience_s:g} s; Ctrl-C ends the command"
                print(f"harness: {line}, which goes on when it is typed again", file=sys.stderr)


@contextmanager
def strangers(what: str = "a package") -> Iterator[None]:
    """Enter a context for code that may be another package's; `what` names it in messages.

    If it tries to end the program (except by a typed Ctrl-C), this raises UserError. A changed
    working folder is put back, and a line on stderr says so; what signals do is put back, too.
    """
    here, handlers = _folder(), {each: signal.getsignal(each) for each in _STOPS}
    try:
        yield
    except BaseException as error:
        if not ends_the_program(error) and not _exits(error):
            raise
        raise ended(what, error) from error
    finally:
        if threading.current_thread() is threading.main_thread():
            for each, handler in handlers.items():
                if handler is not None and signal.getsignal(each) is not handler:
                    signal.signal(each, handler)
        if here and _folder() != here:
            os.chdir(here)
            line = f"{what} changed the working folder; it is {printable(here)} again"
            print(f"harness: {line}", file=sys.stderr)


@contextmanager
def aside(what: str) -> Iterator[None]:
    """Enter a context for another package's code that may print: its stdout goes to stderr.

    So it cannot spoil what a command prints. It can neither end the program nor change the working
    folder, and a line on stderr says if it takes long. `what` names it in messages.
    """
    with watched(what), strangers(what), redirect_stdout(sys.stderr):
        yield


def is_ours(thing: object) -> bool:
    """Return whether an object acts by the harness's own code alone, and not by a package's.

    That is so if its class is defined in a module of the harness, and no attribute that is set on
    the object itself hides a method of that class. The class is looked up in that module, since any
    class may state a false module name.
    """
    kind = type(thing)
    hides = [name for name in getattr(thing, "__dict__", ()) if callable(getattr(kind, name, None))]
    return is_in_harness(kind) and not hides


def is_in_harness(named: Any) -> bool:
    """Return whether a class or function is defined in a module of the harness.

    A package's own can state any module and name, so it is looked up there by its name.
    """
    module = str(getattr(named, "__module__", ""))
    if not module.startswith("harness."):
        return False
    candidate: object = sys.modules.get(module)
    for name in str(getattr(named, "__qualname__", "")).split("."):
        candidate = getattr(candidate, name, None)
    return candidate is named


@contextmanager
def worded(
    what: str,
    built_in: bool = False,
    door: Callable[[str], AbstractContextManager[None]] = strangers,
) -> Iterator[None]:
    """Enter a context for a package's code, whose errors become a one-line UserError.

    `what` names the code in it. If `built_in` is true the code is the harness's own, and runs as it
    is. `door` is the context that it runs in: `strangers` or `aside`.
    """
    if built_in:
        yield
        return
    try:
        with watched(what), door(what):
            yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{what} fails ({_raised(error)}); repair or uninstall the package that registers it"
        ) from error


def label(kind: str, thing: object) -> str:
    """Return what messages call a package's object: its `kind`, its class and that one's module."""
    named = type(thing)
    return f"{kind} {printable(named.__name__)} of {printable(named.__module__)}"


def ends_the_program(error: BaseException) -> bool:
    """Return whether an exception would end the program without being an error.

    SystemExit does so. A Ctrl-C that somebody typed, and `process.Stop` (a signal to stop), do not
    count.
    """
    if isinstance(error, Stop):
        return False
    if (
        isinstance(error, KeyboardInterrupt)
        and threading.current_thread() is threading.main_thread()
    ):
        return signal.getsignal(signal.SIGINT) is not signal.default_int_handler  # as in a notebook
    return not isinstance(error, Exception)


class Ended(UserError):
    """Report which code of a package tried to end the program."""


def ended(what: str, error: BaseException) -> Ended:
    """Build the UserError for code `what` that tried to end the program by raising `error`."""
    return Ended(f"{what} ends the program ({_raised(error)}); repair or uninstall the package")


def _raised(error: BaseException) -> str:
    """Return what was raised, and where."""
    words = ": ".join(filter(None, (type(error).__name__, str(error))))
    last = traceback.extract_tb(error.__traceback__)[-1]
    return printable(f"{words} at {last.filename}:{last.lineno}", 200)


def _exits(error: BaseException) -> bool:
    """Return whether this ends a command of click or typer with an exit code,
    as commands here do.
    """
    kind = type(error)
    return kind.__name__ in ("Exit", "Abort") and kind.__module__.partition(".")[0] in (
        "click",
        "typer",
    )


def _folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was deleted
        return None
