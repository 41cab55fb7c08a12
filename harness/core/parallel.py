"""Work spread over processes: the same results in the same order for any number of workers."""

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int, progress: Callable[[int], None]
) -> list[Result]:
    """`[work(i) for i in items]`; `progress(1)` is called as each is done. `work` must be picklable."""
    todo = list(items)
    if workers <= 1:
        done = []
        for item in todo:
            done.append(work(item))
            progress(1)
        return done
    with ProcessPoolExecutor(workers) as pool:
        futures = [pool.submit(work, item) for item in todo]
        try:
            for future in as_completed(futures):
                future.result()
                progress(1)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]
