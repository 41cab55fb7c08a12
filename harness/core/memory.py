"""Python's garbage collector, kept from walking millions of plain values that hold no cycle."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """No collection of cycles while open. For code that fills memory with JSON or rows, and makes no cycles.

    The collector otherwise walks all that is there each time it has grown by a quarter, which was up to half
    of the time such code took.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
