"""Prompts that begin alike are one group, where that saves tokens."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.backends import engine
from harness.backends.engine import common_length, group_by_beginning


@given(
    st.lists(st.lists(st.integers(0, 1), max_size=30), min_size=1, max_size=9), st.integers(1, 40)
)
def test_each_sequence_is_in_one_group_and_groups_save_what_they_must(
    sequences: list[list[int]], least: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "LEAST_SAVED", least)
        groups = list(group_by_beginning(sequences))
    assert sorted(place for group in groups for place in group) == list(range(len(sequences)))

    def shared(places: Sequence[int]) -> int:
        return common_length([sequences[place] for place in places])

    together = len(sequences) * shared(range(len(sequences)))
    apart = sum(len(group) * shared(group) - (len(group) > 1) * shared(group) for group in groups)
    assert len(groups) == 1 or apart + shared(range(len(sequences))) >= together


def test_groups_are_split_where_that_saves_enough() -> None:
    egos, helpers = ([[n] * 40 + [i] for i in range(3)] for n in (1, 2))
    assert sorted(map(sorted, group_by_beginning([*egos, *helpers]))) == [[0, 1, 2], [3, 4, 5]]
    # nobody shares anything
    assert list(group_by_beginning([[1] * 40, [2] * 40, [3] * 40])) == [[0, 1, 2]]
    deeper = [[1] * 40 + [n] * 40 + [i] for n in (5, 6) for i in range(3)]
    assert sorted(map(sorted, group_by_beginning([*deeper, [9]]))) == [[0, 1, 2], [3, 4, 5], [6]]
