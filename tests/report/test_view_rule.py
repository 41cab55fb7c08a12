"""What part of the world pictures show, on scenes put by hand."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from harness.report.drawing.geometry import LEAST_M, MARGIN_M, View, shadows, spots, view_of
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
        Conflict(
            name, "east", "straight", Point(m, 0.0), EgoArrival(m, None), Arrival(m, None, 0.0)
        )
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
    assert crossed(
        np.array([1.0, 0.0]), np.array([[1.0, 3.0], [1.0, 0.5], [0.0, 3.0]]), lines
    ).tolist() == [
        1,
        0,
        2,
    ]
