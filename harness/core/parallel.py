"""Work spread over processes, or over the nodes of a Ray cluster: the same results, whoever does it.

Whoever asks takes every result, and so is the only one who writes.
"""

import os
import re
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import parent_process
from threading import Thread
from typing import Any, Protocol, TypeVar

from harness.core import extras
from harness.core.errors import Unfinished, UserError, printable

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_WORKERS = 256
TRIES = 3  # of an item whose worker dies of it
_RAY = re.compile(r"ray(?::(//)?([\w.\[\]:-]+:\d+))?", re.ASCII)


@dataclass(frozen=True)
class Ray:
    """A Ray cluster: its address, or None for that of `RAY_ADDRESS`, else one on this machine."""

    address: str | None = None


Workers = int | Ray  # processes, or a cluster


def workers_of(text: str) -> Workers:
    """Who `--workers` names. Raises UserError where it names nobody."""
    if text.isascii() and text.isdigit() and len(text) < 9 and 1 <= int(text) <= MOST_WORKERS:
        return int(text)
    if found := _RAY.fullmatch(text):
        return Ray(text if found[1] else found[2])
    raise UserError(
        f"--workers {printable(text)}: give 1 to {MOST_WORKERS} processes, or ray for a Ray cluster, "
        "ray://HOST:10001 for one elsewhere, ray:HOST:6379 on a node of it"
    )


class Executor(Protocol):
    """Who works. An item that is given comes back once, as its result or as `Lost`."""

    def room(self) -> bool:
        """Whether another item can be given."""
        ...

    def give(self, place: int, item: Any) -> None:
        """Have an item worked on."""
        ...

    def take(self) -> "tuple[int, Any]":
        """Wait for an item: its place, and its result or `Lost`. Raises what the work raises."""
        ...

    def close(self) -> None:
        """End whatever is still worked on."""
        ...


class Lost:
    """What becomes of an item whose worker died."""


def each(
    work: Callable[[Item], Result], items: Iterable[Item], workers: Workers,
    took: Callable[[int, Result], None], named: Callable[[Item], str] = str, repeatable: bool = True,
) -> None:  # fmt: skip
    """Work on items in any order, and take each one's result once, in this process.

    Where work raises, or this is interrupted, the others are ended.

    Args:
        work: what is done with an item; both can be pickled.
        items: what is worked on.
        workers: who works; one worker is this process.
        took: called with an item's place and its result as soon as that is there.
        named: what an item is called in messages.
        repeatable: the same work on another node has to come out the same, or this stops.

    Raises:
        Unfinished: some items' workers died `TRIES` times; all other items are taken.
    """
    given = list(items)
    if workers == 1 or not given:
        for place, item in enumerate(given):
            took(place, work(item))
        return
    executor = _executor(work, given, workers, named, repeatable)
    todo, busy, deaths = deque(range(len(given))), 0, Counter[int]()
    taken, dead = 0, list[int]()
    try:
        while todo or busy:
            while todo and executor.room():
                place = todo.popleft()
                executor.give(place, given[place])
                busy += 1
            place, result = executor.take()
            busy -= 1
            if not isinstance(result, Lost):
                taken += 1
                took(place, result)
                continue
            deaths[place] += 1
            if deaths[place] < TRIES:
                todo.appendleft(place)
                continue
            dead.append(place)
            if not taken and len(dead) == TRIES:  # nothing works: the rest is not tried
                break
    finally:
        executor.close()
    if dead:
        names = ", ".join(named(given[place]) for place in sorted(dead))
        raise Unfinished(
            f"{printable(names)}: the worker was killed {TRIES} times, perhaps because memory ran out; try "
            f"fewer --workers; the other {taken} are done"
        )


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], workers: Workers,
    progress: Callable[[int], None], named: Callable[[Item], str] = str, repeatable: bool = True,
) -> list[Result]:  # fmt: skip
    """`[work(i) for i in items]` (see `each`); `progress(1)` is called as each is done."""
    done: dict[int, Result] = {}

    def took(place: int, result: Result) -> None:
        done[place] = result
        progress(1)

    each(work, items, workers, took, named, repeatable)
    return [done[place] for place in range(len(done))]


def _executor(
    work: Callable[[Any], Any], items: list[Any], workers: Workers, named: Callable[[Any], str],
    repeatable: bool,
) -> Executor:  # fmt: skip
    if isinstance(workers, int):
        return _Processes(work, workers)
    extras.need(f"--workers {workers.address or 'ray'}", "ray")
    from harness.core.ray_tasks import Tasks

    return Tasks(work, workers.address, lambda place: named(items[place]), repeatable)


class _Processes:
    """Processes, each a pool of its own, so that one that dies takes its own item alone with it."""

    def __init__(self, work: Callable[[Any], Any], workers: int) -> None:
        self._work, self._workers = work, workers
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Any], tuple[int, ProcessPoolExecutor]] = {}

    def room(self) -> bool:
        return len(self._busy) < self._workers

    def give(self, place: int, item: Any) -> None:
        pool = self._idle.pop() if self._idle else ProcessPoolExecutor(1, initializer=_begin)
        self._busy[pool.submit(self._work, item)] = place, pool

    def take(self) -> tuple[int, Any]:
        future = wait(self._busy, return_when=FIRST_COMPLETED).done.pop()
        try:
            result = future.result()
        except BrokenProcessPool:
            place, pool = self._busy.pop(future)
            pool.shutdown()
            return place, Lost()
        place, pool = self._busy.pop(future)
        self._idle.append(pool)
        return place, result

    def close(self) -> None:
        pools = [pool for _, pool in self._busy.values()]
        for pool in pools:
            for process in list((pool._processes or {}).values()):  # kill_workers() of Python 3.14
                process.kill()
        for pool in (*pools, *self._idle):
            pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Leave signals to the parent, which kills its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()


def end_with_parent() -> None:
    """Have this process end with its parent, however that ends, also in the middle of its work."""

    def wait() -> None:
        parent = parent_process()
        assert parent
        parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()
