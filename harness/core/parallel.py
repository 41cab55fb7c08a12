"""Map a function over items in processes or on a Ray cluster; the results are the same either way.

The calling process receives every result, so only it writes files.
"""

import os
import re
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, MutableSequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.sharedctypes import RawArray
from threading import Thread
from typing import Any, Protocol, TypeVar

from harness.core import extras
from harness.core.errors import Unfinished, UserError, printable
from harness.core.strangers import strangers

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_WORKERS = 256
TRIES = 3  # attempts at an item whose worker dies
_RAY = re.compile(r"ray(?::(//)?([\w.\[\]:-]+:\d+))?", re.ASCII)


@dataclass(frozen=True)
class Ray:
    """Name a Ray cluster by its address, such as `ray://HOST:10001`, to run items on its nodes.

    None means the cluster of `RAY_ADDRESS`, or else a new one on this machine.
    """

    address: str | None = None  # such as `ray://HOST:10001`; None: see above


Flags = MutableSequence[int]  # 0 or 1 for each worker
Workers = int | Ray  # a number of processes, or a cluster


def workers_of(text: str) -> Workers:
    """Parse the value of `--workers`: a number of processes, or a Ray cluster.

    It is `ray` for a cluster, with `://HOST:10001` or `:HOST:6379` behind for one elsewhere. Raises
    UserError if it is neither.
    """
    if text.isascii() and text.isdigit() and len(text) < 9 and 1 <= int(text) <= MOST_WORKERS:
        return int(text)
    if match := _RAY.fullmatch(text):
        return Ray(text if match[1] else match[2])
    raise UserError(
        f"--workers {printable(text)}: give 1 to {MOST_WORKERS} processes, or ray for a Ray "
        "cluster, ray://HOST:10001 for one elsewhere, ray:HOST:6379 on a node of it"
    )


class Executor(Protocol):
    """Describe what runs items of work on workers (processes, or nodes of a cluster), in any order.

    Each item that is given comes back once, as its result or `WorkerDied`.
    """

    def room(self) -> bool:
        """Return whether another item of work can be submitted now."""
        ...

    def give(self, place: int, item: Any) -> None:
        """Submit an item of work; `place` is its index among all items."""
        ...

    def take(self) -> "tuple[int, Any]":
        """Wait until any item of work is done; return its index, and its result.

        The result is `WorkerDied` if its worker died. Raises what the work raised.
        """
        ...

    def close(self) -> None:
        """Stop all items of work that still run."""
        ...


class WorkerDied:
    """Stand in for the result of an item of work whose worker process died."""


def each(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: Workers,
    on_result: Callable[[int, Result], None],
    label: Callable[[Item], str] = str,
    repeatable: bool = True,
) -> None:
    """Call `work` on every item, in any order, and pass each result once to `on_result`, here.

    If `work` raises, or the call is interrupted, the items that still run are stopped. Raises
    Unfinished if the workers of some items died `TRIES` times; all other items are done.

    Args:
        work: the function; it and the items can be pickled.
        items: its arguments.
        workers: number of processes, 1 for this one, or a Ray cluster.
        on_result: called with an item's index and its result as soon as the result arrives.
        label: gives an item's name in messages.
        repeatable: whether the same item must give the same result on another node;
            a difference is an error.
    """
    inputs = list(items)
    if workers == 1 or not inputs:
        for place, item in enumerate(inputs):
            on_result(place, done(work, item))
        return
    executor = _executor(work, inputs, workers, label, repeatable)
    todo, busy, deaths = deque(range(len(inputs))), 0, Counter[int]()
    n_done, dead = 0, list[int]()
    try:
        while todo or busy:
            while todo and executor.room():
                place = todo.popleft()
                executor.give(place, inputs[place])
                busy += 1
            place, result = executor.take()
            busy -= 1
            if not isinstance(result, WorkerDied):
                n_done += 1
                on_result(place, result)
                continue
            deaths[place] += 1
            if deaths[place] < TRIES:
                todo.appendleft(place)
                continue
            dead.append(place)
            if not n_done and len(dead) == TRIES:  # nothing works, so the rest is not tried
                break
    finally:
        executor.close()
    if dead:
        names = ", ".join(label(inputs[place]) for place in sorted(dead))
        raise Unfinished(
            f"{printable(names)}: the worker was killed {TRIES} times, perhaps because memory ran "
            f"out; try fewer --workers; the other {n_done} are done"
        )


def done(work: Callable[[Item], Result], item: Item) -> Result:
    """Return `work(item)`, guarded from what code of a package may do in it.

    That code may neither end the program (UserError is raised) nor leave it in another working
    folder.
    """
    with strangers():
        return work(item)


def spread(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: Workers,
    progress: Callable[[int], None],
    label: Callable[[Item], str] = str,
    repeatable: bool = True,
) -> list[Result]:
    """Return `[work(i) for i in items]`, computed by workers.

    Args:
        work: the function; it and the items can be pickled.
        items: its arguments.
        workers: number of processes, 1 for this one, or a Ray cluster.
        progress: called as `progress(1)` after every item.
        label: gives an item's name in messages.
        repeatable: whether the same item must give the same result on another node.

    Raises:
        Unfinished: the workers of some items died; all other items are done.
    """
    results: dict[int, Result] = {}

    def on_result(place: int, result: Result) -> None:
        results[place] = result
        progress(1)

    each(work, items, workers, on_result, label, repeatable)
    return [results[place] for place in range(len(results))]


def _executor(
    work: Callable[[Any], Any],
    items: list[Any],
    workers: Workers,
    label: Callable[[Any], str],
    repeatable: bool,
) -> Executor:
    if isinstance(workers, int):
        return _Processes(work, workers, len(items))
    extras.need(f"--workers {workers.address or 'ray'}", "ray")
    from harness.core.ray_tasks import Tasks

    return Tasks(work, workers.address, lambda place: label(items[place]), repeatable)


class _Processes:
    """An executor of processes. Each process is a pool of its own,
    so a death loses one item only.
    """

    def __init__(self, work: Callable[[Any], Any], workers: int, n_items: int) -> None:
        self._work, self._waiting = work, n_items
        n_processes = min(workers, n_items)
        self._at_work: Flags = RawArray("b", [1] * n_processes)
        self._idle: list[tuple[int, ProcessPoolExecutor | None]] = [
            (n, None) for n in range(n_processes)
        ]
        self._busy: dict[Future[Any], tuple[int, int, ProcessPoolExecutor]] = {}

    def room(self) -> bool:
        return bool(self._idle)

    def give(self, place: int, item: Any) -> None:
        number, pool = self._idle.pop()
        pool = pool or ProcessPoolExecutor(1, initializer=_begin, initargs=(self._at_work, number))
        self._busy[pool.submit(done, self._work, item)] = place, number, pool
        self._waiting -= 1

    def take(self) -> tuple[int, Any]:
        future = wait(self._busy, return_when=FIRST_COMPLETED).done.pop()
        try:
            result = future.result()
        except BrokenProcessPool:
            place, number, pool = self._busy.pop(future)
            pool.shutdown()
            self._idle.append((number, None))
            self._waiting += 1
            return place, WorkerDied()
        place, number, pool = self._busy.pop(future)
        self._idle.append((number, pool))
        if not self._waiting:
            self._at_work[number] = 0
        return place, result

    def close(self) -> None:
        pools = [pool for _, _, pool in self._busy.values()]
        for pool in pools:
            for process in list((pool._processes or {}).values()):  # kill_workers() of Python 3.14
                process.kill()
        for pool in (*pools, *(pool for _, pool in self._idle if pool)):
            pool.shutdown(cancel_futures=True)


_shared: tuple[Flags, int] | None = None  # of a worker: which workers have work, and its own number


def share(total: int) -> int:
    """Return how many of `total`, such as threads for a model, this worker may use, at least 1.

    All workers of this machine that still have work divide it; outside a worker, and on a cluster,
    it is all.
    """
    if _shared is None:
        return total
    at_work, number = _shared
    each_has, left_over = divmod(total, max(1, sum(at_work)))
    return max(1, each_has + (sum(at_work[:number]) < left_over))


def _begin(at_work: Flags, number: int) -> None:
    """Ignore signals in a worker: the parent handles them and kills its workers."""
    global _shared
    _shared = at_work, number
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()


def end_with_parent() -> None:
    """End this process as soon as its parent process ends, even in the middle of its work."""

    def wait() -> None:
        parent = parent_process()
        assert parent
        parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()
