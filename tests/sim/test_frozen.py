"""The rule by which frozen episodes are judged, played by hand and as properties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.statistics import Estimate
from harness.evaluate.success import driver_choices, judge
from harness.studies.rank import Standing, frozen_success, ranks_agree

NAN = float("nan")
FRAME_S = 0.02


def verdict(safe, delay_s, avoidable=None, allowance_s=1.0):
    """The one word for one episode."""
    avoidable = [True] * len(safe) if avoidable is None else avoidable
    found = judge(np.array(safe), np.array(delay_s), np.array(avoidable), allowance_s)
    words = [word for word in ("success", "unsafe", "late") if getattr(found, word)]
    assert len(words) == 1
    return words[0]


def test_safe_and_quick_throughout_is_a_success():
    assert verdict([True, True, True], [0.0, 0.0, 0.0]) == "success"


def test_one_needless_slower_is_forgiven_and_two_are_not():
    assert verdict([True, True, True], [0.66, 0.0, 0.0]) == "success"
    assert verdict([True, True, True], [0.66, 0.0, 0.66]) == "late"


def test_one_unsafe_action_is_enough():
    assert verdict([True, False, True], [0.0, NAN, 0.0]) == "unsafe"


def test_unsafe_comes_before_late():
    assert verdict([True, False], [5.0, NAN]) == "unsafe"


def test_a_decision_where_nothing_is_safe_blames_nobody():
    assert verdict([True, False], [0.0, NAN], [True, False]) == "success"
    assert verdict([True, False], [0.0, 9.0], [True, False]) == "success"


def test_the_allowance_itself_is_within_it_and_the_next_frame_is_not():
    assert verdict([True, True], [0.5, 0.5]) == "success"
    assert verdict([True, True], [0.1 * 7, 0.1 * 3]) == "success"  # 1.0 but for rounding
    assert verdict([True, True], [0.5, 0.52]) == "late"


def test_episodes_of_any_leading_shape_are_judged_alike():
    safe = np.array([[[True, True], [True, False]], [[True, True], [False, True]]])
    delay_s = np.where(safe, 0.6, np.nan)
    found = judge(safe, delay_s, np.ones_like(safe), 1.0)
    assert found.unsafe.tolist() == [[False, True], [False, True]]
    assert found.late.tolist() == [[True, False], [True, False]]


decisions = st.lists(
    st.tuples(st.booleans(), st.integers(0, 60).map(lambda n: n * FRAME_S), st.booleans()),
    min_size=1,
    max_size=6,
)


def arrays(episode):
    safe, delay_s, avoidable = (np.array(column) for column in zip(*episode, strict=True))
    # What is safe is avoidable, as in any outcome table.
    return safe, np.where(safe, delay_s, np.nan), avoidable | safe


def judged(episode):
    safe, delay_s, avoidable = arrays(episode)
    return judge(safe, delay_s, avoidable, 1.0)


@given(decisions)
def test_exactly_one_verdict_holds(episode):
    found = judged(episode)
    assert int(found.success) + int(found.unsafe) + int(found.late) == 1


@given(decisions, st.integers(0, 5), st.integers(1, 60))
def test_adding_delay_never_turns_failure_into_success(episode, which, frames):
    safe, delay_s, avoidable = arrays(episode)
    slower = delay_s.copy()
    slower[which % len(slower)] += frames * FRAME_S
    before, after = judge(safe, delay_s, avoidable, 1.0), judge(safe, slower, avoidable, 1.0)
    assert before.success or not after.success
    assert after.unsafe == before.unsafe


@given(decisions, st.randoms())
def test_the_order_of_decisions_changes_nothing(episode, random):
    shuffled = list(episode)
    random.shuffle(shuffled)
    before, after = judged(episode), judged(shuffled)
    assert (before.success, before.unsafe, before.late) == (after.success, after.unsafe, after.late)


@given(decisions, st.integers(1, 3))
def test_padding_changes_nothing(episode, more):
    safe, delay_s, avoidable = arrays(episode)
    padded = judge(
        np.append(safe, [False] * more),
        np.append(delay_s, [NAN] * more),
        np.append(avoidable, [False] * more),
        1.0,
    )
    assert padded.success == judge(safe, delay_s, avoidable, 1.0).success


def test_drivers_choose_in_every_frozen_scene(small):
    cruise, brake = driver_choices(small, "cruise"), driver_choices(small, "brake")
    assert set(cruise) == {small.actions.index("IDLE")}
    assert set(brake) == {small.actions.index("SLOWER")}
    for driver in ("local-view", "full-view"):
        chosen = driver_choices(small, driver)
        assert chosen.shape == (len(small.scenes),)
        assert len(set(chosen)) > 1


def test_the_full_view_driver_is_never_unsafe_where_it_can_be_helped(small):
    safe, _ = small.outcome_arrays()
    chosen = driver_choices(small, "full-view")
    assert safe[np.arange(len(chosen)), chosen][safe.any(axis=1)].all()


def test_frozen_success_is_judged_by_episode(small):
    # Dangers from the left, none, left, right, left, oncoming: cruising is ahead of the first and the last.
    assert frozen_success(small, "cruise").tolist() == [True, True, False, False, False, True]
    assert not frozen_success(small, "brake").any()


def standing(frozen, live):
    nothing = Estimate(0.0, 0.0, 0.0, 1, 0)
    return Standing(Estimate(frozen, 0, 1, 9, 0), Estimate(live, 0, 1, 9, 0), nothing, nothing)


@pytest.mark.parametrize(
    ("shares", "agree"),
    [
        ([(0.9, 0.8), (0.5, 0.4), (0.0, 0.0)], True),
        ([(0.9, 0.8), (0.5, 0.85)], False),
        ([(0.9, 0.8), (0.9, 0.5)], True),
    ],
)
def test_ranks_agree_unless_some_pair_stands_the_other_way(shares, agree):
    assert ranks_agree({str(n): standing(*pair) for n, pair in enumerate(shares)}) is agree
