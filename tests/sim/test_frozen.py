"""The rule by which frozen episodes are judged, on trees drawn by hand and as properties of real ones."""

import numpy as np
import pytest

from harness.dataset.forest import Forest
from harness.dataset.load import Dataset
from harness.dataset.schema import Branching, Danger, Edge, End, Tree

STOP, GO = ACTIONS = ("STOP", "GO")


def leads(action: str, to: int) -> Edge:
    return Edge([action], to, None, 5.0, 0, 0)


def ends(action: str, result: str, time_s: float) -> Edge:
    return Edge([action], None, End(result, time_s, None, None, None), 5.0, 0, 0)  # type: ignore[arg-type]


def point(name: str, full_view: str, *edges: Edge) -> Branching:
    return Branching(name, {"full-view": full_view, "brake": STOP}, list(edges))


def forest(*levels: list[Branching], allowance_s: float = 1.0) -> Forest:
    return Forest.of([Tree(0, 100, Danger(None, None), list(levels), [])], ACTIONS, allowance_s)


@pytest.fixture
def two_steps() -> Forest:
    """Going clears at 4 s; stopping first, then going, at 4.6 s; stopping twice at 5.2 s."""
    return forest(
        [point("start", GO, leads(STOP, 0), leads(GO, 1))],
        [
            point("stopped", GO, ends(STOP, "cleared", 5.2), ends(GO, "cleared", 4.6)),
            point("went", GO, ends(STOP, "collision", 3.0), ends(GO, "cleared", 4.0)),
        ],
    )


def test_the_earliest_success_after_each_action_follows_from_the_leaves_backwards(two_steps: Forest) -> None:
    assert two_steps.earliest_s.tolist() == [[4.6, 4.0], [5.2, 4.6], [np.inf, 4.0]]


def test_an_action_is_safe_while_success_is_possible_and_its_delay_is_what_it_puts_off(
    two_steps: Forest,
) -> None:
    """The full-view driver clears at 4 s, so 5 s is the latest: stopping twice is late, once is forgiven."""
    assert (two_steps.reference_s.tolist(), two_steps.limit_s.tolist()) == ([4.0], [5.01])
    assert two_steps.safe.tolist() == [[True, True], [False, True], [False, True]]
    assert two_steps.value.tolist() == [True, True, True]
    assert two_steps.delay_s[0].tolist() == [pytest.approx(0.6), 0.0]
    assert np.isnan(two_steps.delay_s[1:, 0]).all()
    assert two_steps.driver_success("brake").tolist() == [False]


def test_the_allowance_itself_is_within_it_and_the_next_frame_is_not() -> None:
    for late_s, safe in ((5.0, True), (5.02, False)):
        tree = forest([point("start", GO, ends(STOP, "cleared", late_s), ends(GO, "cleared", 4.0))])
        assert tree.safe.tolist() == [[safe, True]]


def test_where_the_full_view_driver_fails_nothing_is_too_late() -> None:
    tree = forest([point("start", GO, ends(STOP, "cleared", 9.0), ends(GO, "collision", 3.0))])
    assert tree.safe.tolist() == [[True, False]]
    assert tree.reference_s.tolist() == [np.inf]


def test_where_nothing_can_be_saved_there_is_no_value_and_no_regret_to_come() -> None:
    tree = forest([point("start", GO, ends(STOP, "time_out", 10.0), ends(GO, "collision", 3.0))])
    assert (tree.value.tolist(), tree.safe.tolist()) == ([False], [[False, False]])


def test_what_an_action_comes_to_with_the_full_view_driver_is_a_leaf(two_steps: Forest) -> None:
    times = [[two_steps.end(edge).time_s for edge in row] for row in two_steps.then_full_view.tolist()]
    assert times == [[4.6, 4.0], [5.2, 4.6], [3.0, 4.0]]


# Real trees.


def test_a_course_is_lost_by_one_decision_or_was_lost_from_the_start(small: Dataset) -> None:
    """Random walks: success is to have kept the value to the end, failure to have given it away once."""
    f, rng = small.forest, np.random.default_rng(0)
    lost = 0
    for _ in range(200):
        chosen = rng.integers(len(f.actions), size=len(f.ids))
        success = f.succeeds(f.last_edge(chosen), np.arange(len(f.root)))
        met = f.visited(chosen)
        regret = f.value[met] & ~f.safe[met, chosen[met]]
        count = np.bincount(f.tree[met], weights=regret, minlength=len(f.root))
        assert np.array_equal(count, np.where(f.value[f.root], ~success, 0))
        lost += int(count.sum())
    assert lost > 200


def test_delays_along_a_success_add_up_to_what_it_is_behind_the_earliest(small: Dataset) -> None:
    f, rng = small.forest, np.random.default_rng(1)
    for _ in range(100):
        chosen = rng.integers(len(f.actions), size=len(f.ids))
        last, met = f.last_edge(chosen), f.visited(chosen)
        success = f.succeeds(last, np.arange(len(f.root)))
        delay_s = np.bincount(f.tree[met], weights=f.delay_s[met, chosen[met]], minlength=len(f.root))
        behind_s = f.cleared_s[last] - f.earliest_s[f.root].min(axis=1)
        assert delay_s[success] == pytest.approx(behind_s[success])


def test_no_driver_beats_the_best_policy(small: Dataset) -> None:
    best = small.forest.value[small.forest.root]
    for driver in small.forest.drivers:
        assert (small.forest.driver_success(driver) <= best).all()
    assert small.forest.driver_success("full-view").mean() > small.forest.driver_success("cruise").mean()
