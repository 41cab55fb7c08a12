"""How the process begins and ends: its streams, the signals that stop it, and a want of memory."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType
from typing import Any, NoReturn, TextIO

STOPS = {signal.SIGTERM: "terminated", signal.SIGINT: "interrupted"}
# in which the process is gone once its work is done; a tracker may still send things
LEAVE_S = 120.0
GIVEN_UP_S = 2.0  # the same where something hangs that was waited for already
AGAIN_S = 0.05  # after which a stop that fell where nothing can be raised is raised again
# of address space; with less, libraries end the process in ways that cannot be caught
LEAST_MB = 768
# Texts of the errors, other than MemoryError, of a process whose memory ran out.
MEMORY = (
    "failed to map segment",
    "Cannot allocate memory",
    "can't start new thread",
    "Failed to launch worker",
)
STREAMS = {"stdin": "r", "stdout": "w", "stderr": "w"}  # in the order of their numbers


class Stop(KeyboardInterrupt):
    """Report that SIGTERM or SIGINT came, wherever the program is; it holds the signal's number.

    It is raised in the main thread as a KeyboardInterrupt is.
    """

    @property
    def word(self) -> str:
        return STOPS[self.args[0]]

    @property
    def code(self) -> int:
        """Return the exit code as shells have it: 128 plus the signal's number."""
        return 128 + int(self.args[0])


def run(program: Callable[[], object]) -> None:
    """Run the program so that SIGTERM, SIGINT or lack of memory end it with one line on stderr.

    Exit codes are 143, 130 and 2. Standard streams that are closed are replaced by the null device,
    and a character that an encoding lacks is replaced.
    """
    _open_streams()
    _leave_out_wrong_date()
    if lack := _lack():
        print(f"harness: {lack}", file=sys.stderr)
        sys.exit(2)
    stops = _Stops()
    try:
        stops.listen()
        try:
            program()
        finally:
            stops.over = True
    except BaseException as error:
        stops.over = True
        ended_by_itself = isinstance(error, SystemExit) and not stops.terminated
        if stops.seen and not ended_by_itself:
            if not isinstance(error, SystemExit) or error.code != stops.seen.code:  # it is printed
                stops.end()
        elif _lacks_memory(error):
            print("harness: memory ran out; give this command more, or less to do", file=sys.stderr)
            sys.exit(2)
        raise
    finally:
        stops.let_go()
        _leave(sys.exception())


def give_up() -> None:
    """Shorten the wait at the program's exit, after something hung that may hang there again.

    Packages' `atexit` functions then have `GIVEN_UP_S` seconds instead of `LEAVE_S` to finish.
    """
    global LEAVE_S
    LEAVE_S = min(LEAVE_S, GIVEN_UP_S)


def _leave(error: BaseException | None) -> None:
    """Have the process end with this error within `LEAVE_S`, whatever packages left behind.

    Python waits for threads that are no daemons, and calls what was registered with `atexit`:
    both may hang.
    """
    code = getattr(error, "code", 1 if error else 0)
    code = code if isinstance(code, int) else int(code is not None)

    def end() -> None:
        time.sleep(LEAVE_S)
        names = ", ".join(
            ascii(t.name) for t in threading.enumerate() if not t.daemon and t is not main
        )
        what = f"threads that packages left ({names})" if names else "what packages do at the end"
        print(
            f"harness: {what} took longer than {LEAVE_S:g} s; all is written, and it ends",
            file=sys.stderr,
        )
        os._exit(code)

    main = threading.main_thread()
    threading.Thread(target=end, daemon=True).start()


class _Stops:
    """The signals that stop this process.

    Attributes:
        seen: the first that came.
        over: whether the program has ended, and there is nothing to raise a stop in.
    """

    def __init__(self) -> None:
        self.seen: Stop | None = None
        self.over = False
        self._process = os.getpid()

    @property
    def terminated(self) -> bool:
        """Whether SIGTERM came, which is no command's usual end."""
        return self.seen is not None and self.seen.args[0] == signal.SIGTERM

    def listen(self) -> None:
        """Raise `Stop` when a signal comes."""
        for number in STOPS:
            # A shell has what a script starts in the background ignore Ctrl-C.
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._stop)
        sys.unraisablehook = self._unraisable

    def let_go(self) -> None:
        """Leave signals to the system, whose default ends the process while the interpreter shuts
        down.
        """
        for number in STOPS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)

    def end(self) -> NoReturn:
        """End the process at once. Nothing is lost: whatever is kept survives SIGKILL as well."""
        assert self.seen
        with suppress(Exception):
            sys.stdout.flush()
        with suppress(OSError):
            os.write(2, f"harness: {self.seen.word}\n".encode())
        os._exit(self.seen.code)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._process:  # a child that has just been forked
            os._exit(128 + number)
        self.seen = self.seen or Stop(number)
        if self.over or _imports(frame):  # an import may make another error of it, or none
            self.end()
        raise Stop(number)

    def _unraisable(self, what: Any) -> None:
        """Raise a stop again that fell into a finaliser, from which nothing can be raised."""
        if not isinstance(what.exc_value, Stop):
            sys.__unraisablehook__(what)
            return
        number = what.exc_value.args[0]
        signal.signal(signal.SIGALRM, lambda _, frame: self._stop(number, frame))
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)


def _imports(frame: FrameType | None) -> bool:
    """Return whether a module is being imported in a frame or in one that called it."""
    while frame:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _open_streams() -> None:
    """Open streams that are closed, so that no other file gets their numbers;
    write what can be encoded.
    """
    for number, (name, mode) in enumerate(STREAMS.items()):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)  # it gets the lowest free number
            setattr(sys, name, open(null, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
            if null == number:
                os.set_inheritable(null, True)
    for stream in (sys.stdout, sys.stderr):
        # In the C locale, Python writes what it could not decode, and fails at any other character.
        if isinstance(stream, TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")


@contextmanager
def streams_kept(what: str) -> Iterator[None]:
    """Enter a context for code that may close or replace stdout and stderr; both are restored.

    A line on stderr then says that `what`, the name of the code, did so.
    """
    copies = {number: os.dup(number) for number in (1, 2) if _file_at(number)}
    files = {number: _file_at(number) for number in copies}
    streams = {"stdout": sys.stdout, "stderr": sys.stderr}
    try:
        yield
    finally:
        moved: list[object] = [number for number, file in files.items() if _file_at(number) != file]
        for number, copy in copies.items():
            if number in moved:
                os.dup2(copy, number)
            os.close(copy)
        for name, stream in streams.items():
            closed = getattr(stream, "closed", False)
            if closed or getattr(sys, name) is not stream:
                setattr(sys, name, _reopened(stream) if closed else stream)
                moved.append(name)
        if moved:
            line = f"{what} closed or replaced output or error; both are as they were"
            print(f"harness: {line}", file=sys.stderr)


def _file_at(number: int) -> tuple[int, int] | None:
    """Return what tells the open file of a number from others; None if there is none."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _reopened(stream: TextIO) -> TextIO:
    """Return a stream in the place of one that was closed, on the same file."""
    number = 1 if stream is sys.__stdout__ else 2
    coding, errors = stream.encoding, stream.errors
    return open(number, "w", 1, encoding=coding, errors=errors, closefd=False)


def _leave_out_wrong_date() -> None:
    """Remove a wrong date from the environment:
    NumPy, when SciPy imports all of it, fails at one.
    """
    try:
        time.gmtime(int(os.environ.get("SOURCE_DATE_EPOCH", "0")))
    except (ValueError, OverflowError, OSError):
        del os.environ["SOURCE_DATE_EPOCH"]


def _lack() -> str | None:
    """Say what the process lacks to run at all; None if it lacks nothing."""
    try:
        os.getcwd()
    except OSError as error:
        return f"the current folder cannot be read ({error.strerror}); change to one that is there"
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit >> 20 < LEAST_MB:
        return (
            f"the address space is limited to {limit >> 20} MB, and {LEAST_MB} MB are the least; "
            f"raise it with `ulimit -v {LEAST_MB << 10}`"
        )
    return None


def _lacks_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or (
        isinstance(error, Exception) and any(text in str(error) for text in MEMORY)
    )
