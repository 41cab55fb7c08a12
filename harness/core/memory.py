"""Suspend Python's garbage collector while millions of plain values without cycles are created."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Suspend the collection of cycles,
    for code that fills memory with JSON or rows and makes no cycles.

    The collector would otherwise walk everything each time memory has grown by a quarter,
    which took up to half of the time of such code.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
