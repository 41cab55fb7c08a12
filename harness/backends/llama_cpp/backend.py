"""The backend of a GGUF file: llama.cpp in a child process,
since an engine that crashes must end no run.

The process is spawned, so it loads only what its opener imports.
Messages are pickled through a pipe.
"""

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from operator import attrgetter
from pathlib import Path
from threading import Thread
from typing import Any

from harness.backends.base import Completion, Request, failed
from harness.backends.card import Card
from harness.backends.chat import Chat
from harness.backends.registry import import_object
from harness.backends.weights import check_digest, find_gguf
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.parallel import end_with_parent

LOADS = 3  # attempts to load the backend, each ended by the death of its process
LOOK_S = 10.0  # time between two checks whether the process is stopped


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "LlamaBackend":
    """Return the backend of a model card's GGUF file, loaded by llama.cpp in a child process.

    `card` is the model card, the TOML file that describes a model. `device` is `cpu` or `gpu`, None
    for a GPU if there is one; `dtype` may be None or `auto`, since the file decides; `batch_size`
    is the most requests computed together. Raises UserError if the file is not found, does not
    load, or an option is not allowed.
    """
    if dtype not in (None, "auto"):
        raise UserError(
            f"dtype {printable(dtype)!r}; a GGUF file has its own: leave it out, or give auto"
        )
    return LlamaBackend(card, check_digest(card, find_gguf(card)), device, batch_size)


class _Died(Exception):
    """The process has ended; the message says how."""


class Child:
    """Answer requests by a backend in a child process, so that a crash of its engine ends no run.

    Seconds are measured in the child. If it dies, the same requests are asked again together, since
    a different batch may move an answer by rounding. If that kills the engine, too, they are asked
    one at a time, and one that kills it again gets a completion with an error. A process that stays
    stopped is killed.
    """

    def __init__(self, name: str, opener: str, *arguments: Any, **options: Any) -> None:
        """Open a backend in a child process by `opener`, `module:function`, with pickled arguments.

        `name` is the model's in messages. Raises UserError if the opener raised it, or its process
        died `LOADS` times.
        """
        self._name = name
        self._opener = opener, arguments, options
        self._running: tuple[SpawnProcess, Connection] | None = None
        self._start()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        for _ in range(2):
            with suppress(_Died):
                answers: list[Completion] = self._ask("complete", requests)
                return answers
        return [self._alone(request) for request in requests]

    def identity(self) -> dict[str, Any]:
        identity: dict[str, Any] = self.call("identity")
        return identity

    def forget(self) -> None:
        self.call("forget")

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        prompts: list[str] = self.call("rendered", requests)
        return prompts

    def call(self, attribute: str, *arguments: Any, **options: Any) -> Any:
        """Return an attribute of the child's backend, or what it returns if it is a method.

        `attribute` is its name, dotted for an attribute of an attribute; `arguments` and `options`
        are those of the method. Raises UserError if the backend raised it, or died of the call.
        """
        for _ in range(2):
            try:
                return self._ask(attribute, *arguments, **options)
            except _Died as death:
                last = death
        raise UserError(
            f"model {printable(self._name)!r}: {last} of {attribute}; see `harness model check`"
        )

    def close(self) -> None:
        if self._running:
            process, pipe = self._running
            self._running = None
            process.kill()
            process.join()
            process.close()
            pipe.close()

    def _alone(self, request: Request) -> Completion:
        try:
            (answer,) = self._ask("complete", [request])
        except _Died as death:
            return failed(request, str(death))
        completion: Completion = answer
        return completion

    def _start(self) -> None:
        for _ in range(LOADS):
            context = get_context("spawn")
            our_end, child_end = context.Pipe()
            process = context.Process(target=_serve, args=(child_end, *self._opener), daemon=True)
            with _uninterrupted():
                process.start()
            child_end.close()  # otherwise the child's death would not close the pipe
            Thread(target=_watch, args=(process.pid,), daemon=True).start()
            self._running = process, our_end
            try:
                self._receive()
                return
            except _Died as death:
                last = death
            except BaseException:
                self.close()
                raise
        raise UserError(
            f"model {printable(self._name)!r}: {last} while it loaded, {LOADS} times; "
            "it may need more memory than there is, or the file may be damaged"
        )

    def _ask(self, attribute: str, *arguments: Any, **options: Any) -> Any:
        if not self._running:
            self._start()
        assert self._running
        # it died while idle: `_receive` reports that
        with suppress(BrokenPipeError, ConnectionResetError):
            self._running[1].send((attribute, arguments, options))
        return self._receive()

    def _receive(self) -> Any:
        assert self._running
        process, pipe = self._running
        try:
            value, error = pipe.recv()
        except (EOFError, ConnectionResetError):
            process.join()
            code = process.exitcode or 0
            self.close()
            raise _Died(
                f"engine died: {f'signal {-code}' if code < 0 else f'exit code {code}'}"
            ) from None
        except BaseException:  # Ctrl-C: the pending answer must not be taken for the next call's
            self.close()
            raise
        if error:
            raise error
        return value


class LlamaBackend(Child):
    """Answer requests by a GGUF file that a child process has loaded; prompts are rendered here."""

    def __init__(self, card: Card, file: Path, device: str | None, batch_size: int) -> None:
        self.batch_size = batch_size
        super().__init__(
            card.name, "harness.backends.llama_cpp.engine:open_here", card, file, device, batch_size
        )
        self.chat = Chat(
            card.name, _RemoteTokenizer(self), self.call("chat.image_token"), card.system
        )

    def next_log_probs(self, requests: Sequence[Request], vocabulary: int) -> Floats:
        log_p: Floats = self.call("next_log_probs", requests, vocabulary)
        return log_p


class _RemoteTokenizer:
    def __init__(self, child: Child) -> None:
        self._child = child
        facts = (
            child.call(f"chat.tokenizer.{name}")
            for name in ("template", "specials", "bos", "vocabulary")
        )
        self.template, self.specials, self.bos, self.vocabulary = facts

    def encode(self, text: str) -> list[int]:
        return list(self._call("encode", text))

    def decode(self, ids: Sequence[int]) -> str:
        return str(self._call("decode", ids))

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return list(self._call("pieces", ids))

    def candidates(self, letters: str) -> Sequence[int]:
        return range(self.vocabulary)

    def _call(self, attribute: str, *arguments: Any) -> Any:
        return self._child.call(f"chat.tokenizer.{attribute}", *arguments)


def _watch(pid: int) -> None:
    """Kill a process that is found stopped twice in a row;
    otherwise its caller would wait forever.
    """
    before = False
    with suppress(ChildProcessError, AttributeError):  # the process is gone, or this is Windows
        while True:
            time.sleep(LOOK_S)
            stopped = os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
            if stopped and before:
                os.kill(pid, signal.SIGKILL)
            before = stopped


def _serve(
    pipe: Connection, opener: str, arguments: tuple[Any, ...], options: dict[str, Any]
) -> None:
    """Open a backend and answer until the parent is gone. Runs in the child."""
    end_with_parent()
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        backend, error = _attempt(lambda: import_object(opener)(*arguments, **options))
        pipe.send((None, error))
        while not error:
            pipe.send(_attempt(_get, backend, *pipe.recv()))


def _get(backend: Any, attribute: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> Any:
    value = attrgetter(attribute)(backend)
    return value(*arguments, **options) if callable(value) else value


def _attempt(work: Callable[..., Any], *arguments: Any) -> tuple[Any, Exception | None]:
    try:
        return work(*arguments), None
    except UserError as error:
        return None, error
    except Exception:  # a bug: the parent crashes with the child's traceback
        return None, RuntimeError(f"in the engine's process:\n{traceback.format_exc()}")


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Block Ctrl-C in processes that are started inside; the parent receives it and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # started by the first process otherwise, which would unblock SIGINT
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
