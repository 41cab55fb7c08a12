"""The garbage collector is back as it was, whatever happened meanwhile."""

import gc

import pytest

from harness.core.memory import uncollected


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
