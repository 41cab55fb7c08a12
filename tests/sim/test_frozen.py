"""The rule by which frozen episodes are judged,
on trees drawn by hand and as properties of real ones.
"""

from dataclasses import replace

import numpy as np
import pytest

from harness.dataset.forest import Forest
from harness.dataset.load import Dataset
from harness.dataset.schema import Branching, Danger, Edge, End, Tree
from harness.world.outcome import RATINGS
from harness.world.parameters import Parameters

STOP, GO = ACTIONS = ("STOP", "GO")


def leads(action: str, to: int) -> Edge:
    return Edge([action], to, None, 5.0, 0, 0)


def ends(action: str, result: str, time_s: float) -> Edge:
    return Edge([action], None, End(result, time_s, None, None, None), 5.0, 0, 0)  # type: ignore[arg-type]


def point(name: str, full_view: str, *edges: Edge) -> Branching:
    return Branching(name, {"full-view": full_view, "brake": STOP}, list(edges))


def forest(*levels: list[Branching], limits: int = 1, danger: str | None = None) -> Forest:
    tree = Tree(0, 100, Danger(danger, danger and "v9"), list(levels), [])
    return Forest.of([tree], ACTIONS, Parameters(limits=limits))


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


def test_the_earliest_success_after_each_action_follows_from_the_leaves_backwards(
    two_steps: Forest,
) -> None:
    assert two_steps.earliest_s.tolist() == [[4.6, 4.0], [5.2, 4.6], [np.inf, 4.0]]


def test_an_action_is_safe_while_success_is_possible_and_its_delay_is_what_it_puts_off(
    two_steps: Forest,
) -> None:
    """The full-view driver clears at 4 s, so 5 s is the latest:
    stopping twice is late, once is forgiven.
    """
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


def test_where_the_full_view_driver_fails_the_limit_is_that_of_time() -> None:
    for limits in (1, 2):
        start = point("start", GO, ends(STOP, "cleared", 10.0), ends(GO, "collision", 3.0))
        tree = forest([start], limits=limits)
        assert tree.safe.tolist() == [[True, False]]
        assert (tree.reference_s.tolist(), tree.limit_s.tolist()) == ([np.inf], [10.01])


def test_a_needless_stop_is_forgiven_in_danger_and_under_the_first_limits_only() -> None:
    start = point("start", GO, ends(STOP, "cleared", 4.6), ends(GO, "cleared", 4.0))
    for limits, danger, safe in (
        (1, None, True),
        (1, "left", True),
        (2, "left", True),
        (2, None, False),
    ):
        tree = forest([start], limits=limits, danger=danger)
        assert tree.safe.tolist() == [[safe, True]]
        assert tree.false_alarm.tolist() == [[not safe, False]]


def test_a_decision_after_which_harm_is_inevitable_is_a_miss_and_one_that_is_late_alone_a_false_alarm() -> (
    None
):
    """Stopping twice is late and can no longer collide;
    going collides only if the ego then stops.
    """
    tree = forest(
        [point("start", GO, leads(STOP, 0), leads(GO, 1))],
        [
            point("stopped", GO, ends(STOP, "time_out", 10.0), ends(GO, "cleared", 6.0)),
            point("went", GO, ends(STOP, "off_road", 3.0), ends(GO, "cleared", 4.0)),
        ],
    )
    assert tree.avoids_harm.tolist() == [[True, True], [True, True], [False, True]]
    assert tree.miss.tolist() == [[False, False], [False, False], [True, False]]
    assert tree.false_alarm.tolist() == [[True, False], [False, False], [False, False]]


def test_where_harm_cannot_be_avoided_nobody_misses_it() -> None:
    tree = forest([point("start", GO, ends(STOP, "collision", 4.0), ends(GO, "off_road", 3.0))])
    assert not tree.avoids_harm.any()
    assert not tree.miss.any()
    assert not tree.false_alarm.any()


def test_where_nothing_can_be_saved_there_is_no_value_and_no_regret_to_come() -> None:
    tree = forest([point("start", GO, ends(STOP, "time_out", 10.0), ends(GO, "collision", 3.0))])
    assert (tree.value.tolist(), tree.safe.tolist()) == ([False], [[False, False]])


def test_what_an_action_comes_to_with_the_full_view_driver_is_a_leaf(two_steps: Forest) -> None:
    times = [
        [two_steps.end(edge).time_s for edge in row] for row in two_steps.then_full_view.tolist()
    ]
    assert times == [[4.6, 4.0], [5.2, 4.6], [3.0, 4.0]]


# Real trees.


def test_a_course_is_lost_by_one_decision_or_was_lost_from_the_start(small: Dataset) -> None:
    """Random walks: success is to have kept the value to the end,
    failure to have given it away once.
    """
    f, rng = small.forest, np.random.default_rng(0)
    lost = 0
    for _ in range(20):
        chosen = rng.integers(len(f.actions), size=len(f.ids))
        success = f.succeeds(f.last_edge(chosen), np.arange(len(f.root)))
        met = f.visited(chosen)
        regret = f.value[met] & ~f.safe[met, chosen[met]]
        count = np.bincount(f.tree[met], weights=regret, minlength=len(f.root))
        assert np.array_equal(count, np.where(f.value[f.root], ~success, 0))
        lost += int(count.sum())
    assert lost > 20


def test_one_needless_stop_of_a_real_harmless_layout_is_late_under_the_second_limits(
    small: Dataset,
) -> None:
    harmless = [n for n, tree in enumerate(small.trees) if tree.danger.sector is None]
    for limits in (1, 2):
        f = Forest.of(
            tuple(small.trees), small.actions, replace(small.scenario.parameters, limits=limits)
        )
        late = f.false_alarm[f.root[harmless], f.actions.index("SLOWER")]
        assert late.tolist() == [limits == 2] * len(harmless)
        assert f.driver_success("cruise")[harmless].all()
    assert harmless


def test_harm_has_one_miss_and_lateness_one_false_alarm_unless_it_was_inevitable(
    small: Dataset,
) -> None:
    """Random walks, under both versions of the limits."""
    rng = np.random.default_rng(2)
    counts = {"unsafe": 0, "late": 0, "stuck": 0}
    for limits in (1, 2):
        f = Forest.of(
            tuple(small.trees), small.actions, replace(small.scenario.parameters, limits=limits)
        )
        for _ in range(100):
            chosen = rng.integers(len(f.actions), size=len(f.ids))
            met, last = f.visited(chosen), f.last_edge(chosen)
            misses, alarms = (
                np.bincount(f.tree[met], weights=of[met, chosen[met]], minlength=len(f.root))
                for of in (f.miss, f.false_alarm)
            )
            success = f.succeeds(last, np.arange(len(f.root)))
            for tree, edge in enumerate(last.tolist()):
                rating = RATINGS[f.end(edge).result]
                rating = "late" if rating == "success" and not success[tree] else rating
                assert misses[tree] == (rating == "unsafe" and f.avoids_harm[f.root[tree]].any())
                assert alarms[tree] <= 1
                if rating != "unsafe":
                    assert alarms[tree] == (rating != "success" and f.value[f.root[tree]])
                counts[rating] = counts.get(rating, 0) + 1
    assert min(counts.values()) > 0


def test_delays_along_a_success_add_up_to_what_it_is_behind_the_earliest(small: Dataset) -> None:
    f, rng = small.forest, np.random.default_rng(1)
    for _ in range(100):
        chosen = rng.integers(len(f.actions), size=len(f.ids))
        last, met = f.last_edge(chosen), f.visited(chosen)
        success = f.succeeds(last, np.arange(len(f.root)))
        delay_s = np.bincount(
            f.tree[met], weights=f.delay_s[met, chosen[met]], minlength=len(f.root)
        )
        behind_s = f.cleared_s[last] - f.earliest_s[f.root].min(axis=1)
        assert delay_s[success] == pytest.approx(behind_s[success])


def test_no_driver_beats_the_best_policy(small: Dataset) -> None:
    best = small.forest.value[small.forest.root]
    for driver in small.forest.drivers:
        assert (small.forest.driver_success(driver) <= best).all()
    assert (
        small.forest.driver_success("full-view").mean()
        > small.forest.driver_success("cruise").mean()
    )
