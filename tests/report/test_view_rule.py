"""What part of the world pictures and videos show, on scenes put by hand."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from harness.report.drawing.geometry import EASE, LEAST_M, MARGIN_M, View, shadows, spots, view_of, views
from harness.report.drawing.labels import covered, crossed, cut
from harness.world.scene_graph import Arrival, Conflict, Ego, EgoArrival, Point, SceneGraph, Viewer
from harness.world.state import Building, VehicleState, WorldState

EAST = 0.0


def vehicle(name, east, north, part="other"):
    return VehicleState(name, "car", part, east, -north, EAST, 10.0, "west", "straight", False)


def state(*vehicles, buildings=()):
    return WorldState("by-hand", 0, 0, 0.0, 10.0, vehicles, tuple(buildings))


EGO = vehicle("v1", -10.0, 0.0, "ego")
ZONE = 5.0, 0.0


def graph(*met, viewer="v1"):
    """A viewer's conflicts: with whom, and how far ahead of it."""
    conflicts = (
        Conflict(name, "east", "straight", Point(m, 0.0), EgoArrival(m, None), Arrival(m, None, 0.0))
        for name, m in met
    )
    ego = Ego("v1", 10.0, 10.0, 0.0, 15.0, 0.0, 0.0)
    return SceneGraph(viewer, "ego", 0, Viewer(10.0, "west", 15.0), ego, (), tuple(conflicts), ())


def held(*others, met=(), who=(), viewer="v1"):
    return spots(state(EGO, *others), ZONE, graph(*met, viewer=viewer), who).tolist()


def test_a_view_holds_the_ego_where_paths_cross_and_nobody_who_has_no_part():
    assert held(vehicle("v2", 30.0, 0.0)) == [[-10.0, 0.0], [5.0, 0.0]]


def test_it_holds_who_was_asked_the_danger_and_who_is_in_conflict_with_the_conflict_point():
    others = vehicle("v2", 20.0, 9.0), vehicle("v3", 5.0, 30.0), vehicle("v4", 5.0, -40.0)
    shown = held(*others, met=[("v4", 17.0)], who=("v2", "v3", None))
    assert shown == [[-10, 0], [20, 9], [5, 30], [5, -40], [5, 0], [7, 0]]


def test_it_holds_whose_sight_is_shown():
    assert [30.0, 1.0] in held(vehicle("v2", 30.0, 1.0, "helper"), viewer="v2")


def test_a_vehicle_ahead_in_the_lane_is_no_place_where_paths_cross():
    crosses = graph(("v2", 40.0))
    ahead = replace(crosses, conflicts=(replace(crosses.conflicts[0], kind="ahead"),))
    assert len(spots(state(EGO, vehicle("v2", 30.0, 0.0)), ZONE, ahead, ())) == 2


def test_who_is_far_from_the_ego_is_not_followed_and_the_ego_always_is():
    others = vehicle("v2", 62.0, 0.0), vehicle("v3", 62.1, 0.0), vehicle("v4", 0.0, 72.1)
    assert held(*others, who=("v2", "v3", "v4")) == [[-10.0, 0.0], [62.0, 0.0], [5.0, 0.0]]
    assert spots(state(EGO), (500.0, 0.0), None, ("gone",)).tolist() == [[-10.0, 0.0]]


def test_a_view_has_a_least_size_around_the_middle_of_what_it_holds():
    assert view_of(np.array([[-10.0, 0.0], [10.0, 4.0]])) == View(-30.0, -28.0, LEAST_M, LEAST_M)


def test_more_than_that_has_a_margin():
    view = view_of(np.array([[-40.0, 0.0], [30.0, 4.0]]))
    assert view == View(-48.0, -41.0, 86.0, 86.0)
    assert view.scale == 86.0 / 160.0


def test_at_the_end_of_the_world_a_view_shows_what_is_in_it():
    assert view_of(np.array([[-70.0, 0.0]])) == View(-80.0, -30.0, LEAST_M, LEAST_M)
    # Beyond it, who is there with a margin.
    assert view_of(np.array([[-100.0, 0.0]])).west_m == -100.0 - MARGIN_M


def test_a_picture_of_a_road_from_west_to_east_is_low_and_holds_all_the_same():
    assert view_of(np.array([[0.0, 0.0]]), 0.5) == View(-30.0, -15.0, 60.0, 30.0)
    assert view_of(np.array([[0.0, -20.0], [0.0, 20.0]]), 0.5) == View(-56.0, -28.0, 112.0, 56.0)


places = st.lists(st.tuples(*[st.floats(-150, 150)] * 2), min_size=1, max_size=6)


@given(places, st.sampled_from([1.0, 0.6]))
def test_whatever_it_holds_is_in_it_with_a_margin(at, shape):
    view = view_of(np.array(at), shape)
    assert view.holds(np.array(at), MARGIN_M - 1e-6)
    assert view.height_m == pytest.approx(shape * view.width_m)
    assert view.width_m >= LEAST_M


def drive(stills, speed):
    """An ego that drives so many metres a still to the east, and who is asked in every other part."""
    asked = [np.array([[40.0, 50.0]]) if n // 20 % 2 else np.empty((0, 2)) for n in range(stills)]
    return [np.vstack([[-60.0 + speed * n, 0.0], more]) for n, more in enumerate(asked)]


def test_a_video_holds_its_view_and_turns_to_the_next_before_the_decision():
    parts = [n // 20 for n in range(60)]
    shown = views(drive(60, 1.0), parts)
    assert len(shown) == 60
    for part in range(3):
        until = 20 * (part + 1) - (EASE if part < 2 else 0)
        assert len(set(shown[20 * part : until])) == 1
    turning = [view.width_m for view in shown[12:21]]
    assert turning == sorted(turning)
    assert turning[0] > shown[11].width_m, "the first still of a turn moves"
    assert turning[-1] == shown[39 - EASE].width_m


def test_a_video_does_not_jump():
    shown = views(drive(100, 1.0), [n // 20 for n in range(100)])
    most = max(abs(b.width_m - a.width_m) for a, b in pairwise(shown))
    assert most < 0.2 * (max(v.width_m for v in shown) - min(v.width_m for v in shown))


@given(
    st.lists(places.map(np.array), min_size=1, max_size=40),
    st.integers(1, 12),
    st.integers(0, 11),
)
def test_every_still_shows_all_of_what_it_holds_on_the_way_from_view_to_view_too(at, every, begun):
    parts = [(n + begun) // every for n in range(len(at))]
    shown = views(at, parts)
    assert len(shown) == len(at)
    assert all(view.holds(spots, MARGIN_M - 1e-6) for view, spots in zip(shown, at, strict=True))


def test_what_a_wall_or_a_vehicle_hides_is_in_shadow_and_nothing_else():
    wall = Building("b1", 0.0, -20.0, 2.0, -10.0)  # 10 to 20 m north
    scene = state(EGO, vehicle("v2", 0.0, -20.0), buildings=[wall])
    quadrangles = [shapely.Polygon(q) for q in shadows(scene, EGO, 300.0)]
    dark = shapely.union_all(quadrangles)
    for east, north, hidden in (
        (10, 30, True),
        (-5, 5, False),
        (20, -59, True),
        (20, 0, False),
        (-40, 0, False),
    ):
        assert dark.contains(shapely.Point(east, north)) == hidden
    turns = {shapely.is_ccw(q.exterior) for q in quadrangles if q.area > 1e-6}
    assert len(turns) == 1, "by the nonzero rule shadows that overlap do not make light"


def test_a_label_knows_whom_it_covers_what_is_cut_and_which_lines_it_crosses():
    half = np.array([2.0, 1.0])
    at = np.array([[0.0, 0.0], [5.0, 0.0], [9.5, 0.0]])
    boxes = [np.array([[1.0, 0.5], [2.0, 3.0]]), np.array([[6.0, -3.0], [8.0, 3.0]])]
    assert covered(at, half, boxes).tolist() == [1, 1, 1]
    assert covered(at, half, boxes[:1]).tolist() == [1, 0, 0]
    assert cut(at, half, View(-2.0, -5.0, 10.0, 10.0)).tolist() == [0.0, 0.0, 3.5]
    lines = [np.array([[0.0, 1.0], [2.0, 1.0]]), np.array([[0.0, 2.0], [0.5, 2.0]])]
    assert crossed(np.array([1.0, 0.0]), np.array([[1.0, 3.0], [1.0, 0.5], [0.0, 3.0]]), lines).tolist() == [
        1,
        0,
        2,
    ]
