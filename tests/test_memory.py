"""The garbage collector is back as it was, whatever happened meanwhile; large blocks go back."""

import gc
import platform
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from harness.core.memory import LARGE, return_large_blocks, uncollected


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc alone")
def test_large_blocks_that_are_freed_go_back_to_the_system_one_by_one():
    """In a new process: one that has freed much before has room for such blocks already."""
    with get_context("spawn").Pool(1) as pool:
        full, freed, size, kept = pool.apply(of_freed_blocks)
    assert freed < full - 4 * size
    assert kept == 1


def of_freed_blocks() -> tuple[int, int, int, int]:
    """Bytes in memory with six blocks and with one, the size of one, and how many are left."""
    size = 4 * LARGE
    np.ones(size, dtype=np.uint8)  # after which glibc would keep blocks of this size
    return_large_blocks()
    blocks = [np.ones(size, dtype=np.uint8) for _ in range(6)]
    full = resident()
    blocks = blocks[-1:]
    return full, resident(), size, len(blocks)


def test_nothing_is_collected_inside_and_all_is_as_before_outside():
    with uncollected():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_a_failure_inside_turns_it_on_again():
    with pytest.raises(ValueError, match="torn"), uncollected():
        raise ValueError("torn")
    assert gc.isenabled()


def test_a_collector_that_was_off_stays_off():
    gc.disable()
    try:
        with uncollected():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
