"""What becomes of memory in between: Python's garbage collector, and blocks that are freed."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache

LARGE = 1 << 22  # bytes of a block that goes back to the system when it is freed
SPARE = 1 << 25  # bytes at the end of the heap that do not
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # as glibc's malloc.h numbers them


@cache
def return_large_blocks() -> None:
    """Have blocks of `LARGE` bytes go back to the system as soon as they are freed.

    The C library, glibc, else keeps blocks up to the largest that was ever freed, and columns of
    millions of rows leave gaps between what stays, twice what they take. Others than glibc are left
    as they are.
    """
    import ctypes

    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, LARGE)
        mallopt(_TRIM_THRESHOLD, SPARE)


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
