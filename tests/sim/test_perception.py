"""Sensors, lines of sight and scene graphs, on scenes placed by hand,
and that nothing hidden leaks.
"""

import dataclasses
import math

import numpy as np
import pytest
from former import SCENARIO
from msgspec.structs import replace
from together import act_together

from harness.world.perception.graph import scene_graph, scene_graphs, sectors_in_sight, truth_graph
from harness.world.perception.rays import RAYS, blocked_by, sweep
from harness.world.perception.sensors import detect, detections
from harness.world.scene_graph import Arrival, EgoArrival, Point, Sector
from harness.world.state import Building, VehicleState, WorldState
from harness.world.world import World

NORTH, EAST, SOUTH, WEST = -math.pi / 2, 0.0, math.pi / 2, math.pi
EGO = VehicleState("v1", "car", "ego", 2.0, 52.0, NORTH, 14.0, "own", "straight", False)


def other(
    x, y, heading=NORTH, speed=10.0, kind="car", approach="left", route="straight", vehicle="v5"
):
    return VehicleState(vehicle, kind, "other", x, y, heading, speed, approach, route, False)


def scene(*others, buildings=(), ego=EGO, step=0, seed=0):
    return WorldState("by hand", seed, step, 0.0, 14.0, (ego, *others), tuple(buildings))


def seen(state, viewer=None):
    """Detections by id."""
    viewer = viewer or state.ego
    return {d.id: d for d in detect(state, viewer, SCENARIO.parameters)}


def ahead(distance_m, off_axis_deg=0.0, **kwargs):
    """A car at a bearing from the ego's heading, clockwise."""
    angle = NORTH + math.radians(off_axis_deg)
    return other(
        EGO.x_m + distance_m * math.cos(angle), EGO.y_m + distance_m * math.sin(angle), **kwargs
    )


# Lines of sight.

WALL = Building("b1", west_m=-10.0, north_m=20.0, east_m=10.0, south_m=30.0)


def test_a_car_behind_a_building_is_not_seen_and_one_beside_it_is():
    assert seen(scene(other(2.0, 0.0), buildings=[WALL])) == {}
    assert seen(scene(other(2.0, 0.0))).keys() == {"v5"}
    assert seen(scene(other(30.0, 20.0), buildings=[WALL])).keys() == {"v5"}


def test_a_car_that_looks_out_from_behind_a_corner_is_seen():
    # From (2, 52) the building's south-east corner (10, 30) hides what is west of x = 20.9 at y =
    # 0.
    hidden, half = other(17.0, 0.0, heading=EAST), other(21.0, 0.0, heading=EAST)
    assert seen(scene(hidden, buildings=[WALL])) == {}
    assert seen(scene(half, buildings=[WALL])).keys() == {"v5"}


def test_a_truck_hides_the_car_right_behind_it():
    truck = other(2.0, 20.0, kind="truck")
    follower = other(2.0, 5.0, vehicle="v6")
    assert seen(scene(truck, follower)).keys() == {"v5"}
    assert seen(scene(truck, replace(follower, x_m=12.0))).keys() == {"v5", "v6"}


def test_a_ray_ends_on_the_first_surface_it_meets():
    near, far = Building("b1", 1.0, 46.0, 3.0, 47.0), Building("b2", 1.0, 43.0, 3.0, 44.0)
    view = sweep(scene(buildings=[far, near]), EGO)
    north, south = 3 * RAYS // 4, RAYS // 4
    assert view.range_m[[north, south]].tolist() == [pytest.approx(5.0), math.inf]
    assert north in view.hits["b1"]
    assert north not in view.hits.get("b2", ())


def test_points_are_seen_up_to_the_wall_that_hides_those_behind_it():
    points = np.array([[2.0, 40.0], [2.0, 10.0], [40.0, 10.0]])
    assert blocked_by(scene(buildings=[WALL]), EGO, points) == [None, "b1", None]


# Which sensor sees what.


@pytest.mark.parametrize(
    ("distance_m", "off_axis_deg", "sensors"),
    [
        (59.0, 0.0, ("camera", "lidar", "radar")),
        (59.0, 59.0, ("camera", "lidar", "radar")),
        (59.0, 61.0, ("lidar",)),
        (59.0, 90.0, ("lidar",)),
        (59.0, 119.0, ("lidar",)),
        (59.0, 121.0, ("camera", "lidar", "radar")),
        (59.0, 180.0, ("camera", "lidar", "radar")),
        (61.0, 0.0, ("lidar", "radar")),
        (79.0, 0.0, ("lidar", "radar")),
        (81.0, 0.0, ("radar",)),
        (149.0, 0.0, ("radar",)),
        (151.0, 0.0, None),
        (81.0, 90.0, None),
    ],
)
def test_every_sensor_has_its_reach_and_its_field(distance_m, off_axis_deg, sensors):
    found = seen(scene(ahead(distance_m, off_axis_deg, heading=EAST, kind="truck")))
    assert found.get("v5", None) is None if sensors is None else found["v5"].sensors == sensors


def test_only_the_camera_knows_the_kind_and_the_indicator():
    near = seen(scene(ahead(30.0, kind="truck", route="left")))["v5"]
    far = seen(scene(ahead(70.0, kind="truck", route="left")))["v5"]
    assert (near.kind, near.indicator) == ("truck", "left")
    assert (far.kind, far.indicator) == (None, None)


@pytest.mark.parametrize(
    ("kind", "signals"), [("bicycle", None), ("motorcycle", "left"), ("pedestrian", None)]
)
def test_a_narrow_road_user_is_seen_in_the_open_as_what_it_is(kind, signals):
    near = seen(scene(ahead(40.0, heading=EAST, kind=kind, route="left")))["v5"]
    assert (near.kind, near.indicator) == (kind, signals)


@pytest.mark.parametrize(("kind", "hides"), [("truck", True), ("bicycle", False)])
def test_a_bicycle_hides_what_a_bicycle_hides(kind, hides):
    """Behind it, seen from the side, a car of 5 m and a pedestrian."""
    between, behind = other(2.0, 40.0, heading=EAST, kind=kind), other(2.0, 30.0, heading=EAST)
    assert ("v5" in seen(scene(replace(between, id="v6"), behind))) != hides
    walker = replace(behind, kind="pedestrian")
    assert "v5" not in seen(scene(replace(between, id="v6"), walker))


def test_only_the_lidar_knows_a_heading():
    assert seen(scene(ahead(70.0)))["v5"].heading_rad is not None
    assert seen(scene(ahead(100.0)))["v5"].heading_rad is None


def test_range_rate_is_negative_while_closing_and_positive_while_parting():
    closing = seen(scene(ahead(50.0, heading=SOUTH, speed=10.0)))["v5"]
    parting = seen(scene(ahead(50.0, heading=NORTH, speed=20.0)))["v5"]
    assert closing.range_rate_mps == pytest.approx(-24.0, abs=0.75)
    assert parting.range_rate_mps == pytest.approx(6.0, abs=0.75)
    assert seen(scene(ahead(50.0, 90.0)))["v5"].range_rate_mps is None


# A vehicle that is not reported, under `perception` 2.

TRANSPARENT = dataclasses.replace(SCENARIO.parameters, perception=2)


def reported(state, parameters=TRANSPARENT):
    return [d.id for d in detect(state, EGO, parameters)]


def test_a_van_on_which_too_few_rays_end_does_not_hide_the_car_behind_it():
    # Past the corner one ray ends on the van and two on the car, which has three to itself.
    van, car = other(17.0, 5.0, kind="van"), other(23.4, -10.0, vehicle="v6")
    for state in (scene(van, car, buildings=[WALL]), scene(car, buildings=[WALL])):
        assert reported(state) == ["v6"]
    assert reported(scene(van, car, buildings=[WALL]), SCENARIO.parameters) == []


def test_a_truck_that_is_reported_hides_the_car_right_behind_it():
    assert reported(scene(other(2.0, 20.0, kind="truck"), other(2.0, 5.0, vehicle="v6"))) == ["v5"]


def test_of_two_that_would_take_turns_in_hiding_each_other_none_is_reported():
    # Crashed into each other far away: three rays come to each alone, and fewer to either beside
    # the other.
    one, two = (
        other(1.204, -86.629, heading=-1.585),
        other(1.3734, -86.6521, heading=-1.519, vehicle="v6"),
    )
    assert reported(scene(one)) == ["v5"]
    assert reported(scene(two)) == ["v6"]
    assert reported(scene(one, two)) == []


def draws(distance_m, off_axis_deg=0.0, n=4000):
    """Many detections of one car, one a step."""
    first = scene(ahead(distance_m, off_axis_deg, heading=WEST, speed=10.0))
    pairs = [(replace(first, step=step), EGO, first.vehicles[1]) for step in range(n)]
    return detections(pairs, SCENARIO.parameters.light)


def spread(values):
    return float(np.std(np.array(values)))


@pytest.mark.slow
def test_lidar_noise_is_what_is_stated():
    found = draws(70.0, 90.0)
    truth = ahead(70.0, 90.0)
    assert spread([d.x_m for d in found]) == pytest.approx(0.1, rel=0.06)
    assert spread([d.y_m for d in found]) == pytest.approx(0.1, rel=0.06)
    assert spread([d.heading_rad for d in found]) == pytest.approx(math.radians(2.0), rel=0.06)
    assert spread([d.speed_mps for d in found]) == pytest.approx(0.8, rel=0.06)
    assert np.mean([d.x_m for d in found]) == pytest.approx(truth.x_m, abs=0.01)
    assert np.mean([d.speed_mps for d in found]) == pytest.approx(10.0, abs=0.06)


@pytest.mark.slow
def test_radar_noise_is_what_is_stated():
    found = draws(100.0)
    assert spread([d.y_m for d in found]) == pytest.approx(0.4, rel=0.06)  # range, straight ahead
    # bearing
    assert spread([d.x_m for d in found]) == pytest.approx(100.0 * math.radians(1.0), rel=0.06)
    assert spread([d.range_rate_mps for d in found]) == pytest.approx(0.15, rel=0.06)
    assert spread([d.speed_mps for d in found]) == pytest.approx(0.2, rel=0.06)


def test_noise_is_a_draw_for_episode_step_viewer_and_object():
    state = scene(ahead(30.0))
    assert seen(state) == seen(state)
    assert seen(state)["v5"].x_m != seen(replace(state, step=1))["v5"].x_m
    assert seen(state)["v5"].x_m != seen(replace(state, episode_seed=1))["v5"].x_m


def test_a_standing_car_never_has_a_negative_speed():
    assert min(d.speed_mps for d in draws_of(ahead(70.0, 90.0, speed=0.0))) == 0.0


def draws_of(vehicle, n=200):
    first = scene(vehicle)
    pairs = [(replace(first, step=step), EGO, first.vehicles[1]) for step in range(n)]
    return detections(pairs, SCENARIO.parameters.light)


# The graph.


def test_positions_are_forward_and_to_the_left_and_headings_counter_clockwise():
    # The ego looks north; a car 20 m ahead and 6 m to the left drives east, to the ego's right.
    (node,) = truth_graph(SCENARIO, scene(other(-4.0, 32.0, heading=EAST))).nodes
    assert (node.forward_m, node.left_m, node.heading_deg) == (20.0, 6.0, -90)
    (node,) = truth_graph(SCENARIO, scene(other(2.0, 72.0, heading=WEST))).nodes
    assert (node.forward_m, node.left_m, node.heading_deg) == (-20.0, 0.0, 90)


def test_a_conflict_has_the_arc_lengths_and_times_of_both():
    # The ego at y 52 has 50 m to the crossing at (2, 2); a car at x −38 has 40 m at 10 m/s.
    graph = truth_graph(SCENARIO, scene(other(-38.0, 2.0, heading=EAST, speed=10.0)))
    (conflict,) = graph.conflicts
    assert (conflict.vehicle, conflict.sector, conflict.route) == ("v5", "left", "straight")
    assert conflict.point == Point(50.0, 0.0)
    assert conflict.ego == EgoArrival(50.0, 3.6)
    assert conflict.other == Arrival(40.0, 4.0, 10.0)


def test_a_standing_car_has_an_arc_length_and_no_time():
    (conflict,) = truth_graph(SCENARIO, scene(other(-38.0, 2.0, heading=EAST, speed=0.0))).conflicts
    assert conflict.other == Arrival(40.0, None, 0.0)


def test_an_oncoming_car_is_a_conflict_only_if_it_turns_left():
    straight = other(-2.0, -40.0, heading=SOUTH, approach="oncoming")
    assert truth_graph(SCENARIO, scene(straight)).conflicts == ()
    (conflict,) = truth_graph(SCENARIO, scene(replace(straight, route="left"))).conflicts
    assert (conflict.sector, conflict.route) == ("oncoming", "left")


def test_a_car_that_has_passed_the_conflict_point_is_none():
    assert truth_graph(SCENARIO, scene(other(10.0, 2.0, heading=EAST))).conflicts == ()
    assert (
        truth_graph(SCENARIO, scene(other(6.0, 2.0, heading=EAST))).conflicts != []
    )  # its tail is still there


def test_lanes_are_named_from_the_egos_seat_and_off_the_road_there_is_none():
    lanes = {
        "approach-left": other(-38.0, 2.0, heading=EAST),
        "approach-right": other(38.0, -2.0, heading=WEST),
        "exit-ahead": other(2.0, -30.0, heading=NORTH),
        "junction": other(0.0, 2.0, heading=EAST),
        "off-lane": other(30.0, 30.0),
    }
    for lane, vehicle in lanes.items():
        assert truth_graph(SCENARIO, scene(vehicle)).nodes[0].lane == lane


def test_a_helper_judges_the_egos_conflicts_from_its_own_seat():
    helper = replace(other(30.0, 2.0, heading=EAST, vehicle="v2"), part="helper")
    danger = other(-38.0, 2.0, heading=EAST)
    graph = scene_graph(SCENARIO, scene(helper, danger), "v2")
    (conflict,) = graph.conflicts
    assert (graph.role, conflict.vehicle, conflict.sector) == ("helper", "v5", "left")
    assert conflict.ego == EgoArrival(50.0, 3.6)  # by the request, so without noise
    assert conflict.point == Point(-28.0, 0.0)
    assert (graph.ego.forward_m, graph.ego.left_m) == (-28.0, -50.0)


def test_a_sector_behind_a_building_is_occluded_by_it_and_an_open_one_is_not():
    corner = Building("b1", west_m=-70.0, north_m=8.0, east_m=-8.0, south_m=70.0)
    sectors = {s.sector: s for s in scene_graph(SCENARIO, scene(buildings=[corner]), "v1").sectors}
    assert sectors["left"].occluded
    assert sectors["left"].by == ("b1",)
    assert sectors["left"].seen_share < 0.5
    assert sectors["right"] == Sector("right", 1.0, False, ())


def test_a_reported_truck_hides_a_stretch_of_a_sector_and_is_named():
    truck = other(-2.0, -20.0, heading=SOUTH, kind="truck", approach="oncoming")
    sectors = {s.sector: s for s in scene_graph(SCENARIO, scene(truck), "v1").sectors}
    assert sectors["oncoming"].by == ("v5",)
    assert sectors["oncoming"].seen_share < 1.0


def test_sectors_alone_are_those_of_the_graphs():
    truck = other(-2.0, -20.0, heading=SOUTH, kind="truck", approach="oncoming")
    hidden = other(-2.0, -30.0, heading=SOUTH, vehicle="v6", approach="oncoming")
    states = [scene(truck, hidden), *(World.start(SCENARIO, seed).state() for seed in range(4))]
    looks = [(state, v.id) for state in states for v in state.vehicles]
    graphs = scene_graphs(SCENARIO, looks)
    sectors = sectors_in_sight(SCENARIO, looks)
    assert [tuple(some) for some in sectors] == [graph.sectors for graph in graphs]
    assert len({sector.seen_share for some in sectors for sector in some}) > 5


# Nothing hidden leaks.


def without(state, vehicle):
    return replace(state, vehicles=tuple(v for v in state.vehicles if v.id != vehicle))


@pytest.mark.slow
def test_a_graph_does_not_change_when_what_it_does_not_list_is_taken_away():
    hidden, worlds = 0, [World.start(SCENARIO, seed) for seed in range(4)]
    for action in ("IDLE", "SLOWER", "IDLE", "FASTER", "IDLE"):
        for state in [world.state() for world in worlds if not world.outcome.ended]:
            for viewer in (state.ego, *state.helpers):
                graph = scene_graph(SCENARIO, state, viewer.id)
                listed = {node.id for node in graph.nodes} | {viewer.id, state.ego.id}
                for unlisted in {v.id for v in state.vehicles} - listed:
                    hidden += 1
                    less = scene_graph(SCENARIO, without(state, unlisted), viewer.id)
                    assert less == graph, (state.episode_seed, state.step, viewer.id, unlisted)
        act_together(worlds, [action] * len(worlds))
    assert hidden > 50


@pytest.mark.slow
def test_an_episode_without_its_danger_looks_the_same_for_as_long_as_the_ego_does_not_see_it():
    worlds = [world for seed in range(24) if (world := World.start(SCENARIO, seed)).layout.danger]
    harmless = [world.branch() for world in worlds]
    for world in harmless:
        vehicles = world.road.vehicles
        vehicles[:] = [v for v in vehicles if v.spawn.id != world.layout.danger_id]
    hidden_steps = 0
    for _ in range(4):
        for world, without_it in zip(worlds, harmless, strict=True):
            graph = scene_graph(SCENARIO, world.state(), "v1")
            if world.layout.danger_id not in {node.id for node in graph.nodes}:
                hidden_steps += 1
                assert scene_graph(SCENARIO, without_it.state(), "v1") == graph
        act_together([*worlds, *harmless], ["IDLE"] * 2 * len(worlds))
    assert hidden_steps > 40


@pytest.mark.slow
def test_a_graph_names_only_its_viewer_the_ego_what_it_lists_and_buildings():
    for seed in (1, 6):
        world = World.start(SCENARIO, seed)
        for _ in range(4):
            state = world.state()
            for viewer in (state.ego, *state.helpers):
                graph = scene_graph(SCENARIO, state, viewer.id)
                known = {node.id for node in graph.nodes}
                assert {c.vehicle for c in graph.conflicts} <= known
                hiding = {name for s in graph.sectors for name in s.by}
                assert hiding <= known | {b.id for b in state.buildings}
            world.act("IDLE")


@pytest.mark.exhaustive
def test_most_dangers_are_hidden_from_the_ego_and_seen_by_a_helper_two_decisions_before():
    hidden = helped = 0
    worlds = [world for seed in range(40) if (world := World.start(SCENARIO, seed)).layout.danger]
    for _ in range(2):
        act_together(worlds, ["IDLE"] * len(worlds))
    for world in worlds:
        state, danger = world.state(), world.layout.danger_id
        views = [
            {n.id for n in scene_graph(SCENARIO, state, v.id).nodes}
            for v in (state.ego, *state.helpers)
        ]
        hidden += danger not in views[0]
        helped += any(danger in view for view in views[1:])
    assert hidden / len(worlds) > 0.8
    assert helped / len(worlds) > 0.9
