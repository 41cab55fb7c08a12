"""Suspend Python's garbage collector while millions of plain values without cycles are created."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Enter a context in which Python's garbage collector does not run, to create many objects.

    They must have no cycles. The collector would walk all objects whenever memory has grown by a
    quarter, which is much of the time of code that reads JSON or rows.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
