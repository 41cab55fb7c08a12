"""Work spread over processes: the same results in the same order for any number of workers."""

import os
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import parent_process
from threading import Thread
from typing import TypeVar

from harness.core.errors import UserError

Item = TypeVar("Item")
Result = TypeVar("Result")


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int, progress: Callable[[int], None]
) -> list[Result]:
    """`[work(i) for i in items]`; `progress(1)` is called as each is done. `work` must be picklable.

    Where one raises, or this is interrupted, the others are killed.
    """
    todo = list(items)
    if workers <= 1:
        done = []
        for item in todo:
            done.append(work(item))
            progress(1)
        return done
    pool = ProcessPoolExecutor(workers, initializer=_begin)
    futures = [pool.submit(work, item) for item in todo]
    try:
        for future in as_completed(futures):
            future.result()
            progress(1)
        return [future.result() for future in futures]
    except BrokenProcessPool:
        raise UserError(
            "a worker process was killed, perhaps because memory ran out; try fewer --workers"
        ) from None
    finally:
        if not all(future.done() for future in futures):
            for process in list((pool._processes or {}).values()):  # kill_workers() of Python 3.14
                process.kill()
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
