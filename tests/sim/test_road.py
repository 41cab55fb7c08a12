"""Paths and conflict points, against highway-env's own road network and by hand."""

import math
import subprocess
import sys

import numpy as np
import pytest
from highway_env.envs.intersection_env import IntersectionEnv
from hypothesis import given
from hypothesis import strategies as st

from harness.world import crossroads, scenarios
from harness.world.crossroads import APPROACHES, ARM_M, ROUTES, paths, road

KEYS = [(approach, route) for approach in APPROACHES for route in ROUTES]


@pytest.fixture(scope="module")
def network():
    return IntersectionEnv().road.network


def lanes(network, approach, route):
    """highway-env's approach, junction and exit lane of one way through."""
    start = APPROACHES.index(approach)
    end = (start + {"straight": 2, "left": 1}[route]) % 4
    nodes = [(f"o{start}", f"ir{start}"), (f"ir{start}", f"il{end}"), (f"il{end}", f"o{end}")]
    return [network.get_lane((a, b, 0)) for a, b in nodes]


def test_the_network_is_highway_envs_to_the_last_bit(network):
    ours = crossroads.network()
    assert [*ours.graph] == [*network.graph]
    for begin, lanes_to in network.graph.items():
        assert [*ours.graph[begin]] == [*lanes_to]
        for end, [theirs] in lanes_to.items():
            [lane] = ours.graph[begin][end]
            assert type(lane) is type(theirs)
            for name, value in vars(theirs).items():
                if name not in ("priority", "speed_limit"):  # which nobody reads here
                    assert np.array_equal(getattr(lane, name), value), (begin, end, name)


@pytest.mark.slow
def test_a_world_loads_no_environment_and_who_asks_for_one_gets_it():
    program = """
import sys
from harness.world import highway, scenarios
from harness.world.world import World
for name in scenarios.names():
    World.start(scenarios.get(name), 5).advance(3)
assert not {"highway_env", "pandas", "matplotlib", "pygame"} & set(sys.modules)
import highway_env.road.lane
import gymnasium
assert highway_env.road.lane.StraightLane is highway.StraightLane
assert highway_env.vehicle.controller.MDPVehicle is highway.MDPVehicle
assert highway_env.__version__ and "highway-v0" in gymnasium.registry
environment = gymnasium.make("highway-v0")
environment.reset(seed=1)
assert isinstance(environment.unwrapped.vehicle, highway.MDPVehicle)
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize(("approach", "route"), KEYS)
def test_a_path_runs_along_the_middle_of_highway_envs_lanes(network, approach, route):
    path = paths()[approach, route]
    starts = (0.0, *path.ends_m)
    for lane, start in zip(lanes(network, approach, route), starts, strict=True):
        for along in np.linspace(0.0, lane.length, 9)[1:-1]:
            x, y, heading = path.at(start + along)
            assert lane.local_coordinates(np.array([x, y])) == pytest.approx((along, 0.0), abs=0.01)
            assert math.cos(heading - lane.heading_at(along)) > math.cos(math.radians(1.5))


@pytest.mark.parametrize(("approach", "route"), KEYS)
def test_the_right_of_way_is_highway_envs(network, approach, route):
    assert lanes(network, approach, route)[1].priority == paths()[approach, route].priority


def test_conflict_points_lie_where_geometry_puts_them():
    # Lane centres are 2 m off the centre lines; a left turn is a circle of radius 13 m about (11,
    # ±11).
    dip = 11 - math.sqrt(13**2 - 9**2)
    turned = 13 * math.atan2(math.sqrt(13**2 - 9**2), 9)
    by_hand = {
        ("left", "straight"): (2.0, 2.0, 109.0, 113.0),
        ("right", "straight"): (2.0, -2.0, 113.0, 109.0),
        ("oncoming", "left"): (2.0, -dip, 111.0 + dip, 100.0 + turned),
        ("right", "left"): (2.0, dip, 111.0 - dip, 100.0 + 13 * math.pi / 2 - turned),
    }
    # the others merge with the ego's lane or never meet it
    assert road().crossings.keys() == by_hand.keys()
    for key, expected in by_hand.items():
        c = road().crossings[key]
        assert (c.x_m, c.y_m, c.ego_arc_m) == pytest.approx(expected[:3], abs=0.005)


def test_arc_lengths_to_the_conflict_points_are_those_of_the_lanes():
    assert road().crossings["left", "straight"].other_arc_m == pytest.approx(113.0, abs=0.01)
    assert road().crossings["right", "straight"].other_arc_m == pytest.approx(109.0, abs=0.01)
    on_circle = 13 * math.atan2(math.sqrt(13**2 - 9**2), 9)
    assert road().crossings["oncoming", "left"].other_arc_m == pytest.approx(
        100.0 + on_circle, abs=0.05
    )


def test_the_conflict_zone_is_the_centroid_of_the_three_dangers_conflict_points():
    oncoming_y = -(11 - math.sqrt(13**2 - 9**2))
    assert road().zone_m == pytest.approx((2.0, oncoming_y / 3), abs=0.01)
    assert road().zone_m[1] < 0 < 2.0 + oncoming_y  # between the two crossing lanes


@given(st.sampled_from(KEYS), st.floats(0.0, 200.0), st.floats(-1.5, 1.5))
def test_a_point_beside_a_path_projects_back_to_its_foot(key, arc_m, aside_m):
    path = paths()[key]
    x, y, heading = path.at(arc_m)
    found, lateral, along = path.project(
        x - aside_m * math.sin(heading), y + aside_m * math.cos(heading)
    )
    assert found == pytest.approx(arc_m, abs=0.1)
    assert lateral == pytest.approx(abs(aside_m), abs=0.05)
    assert math.cos(along - heading) > 0.999


def test_lane_roles_are_named_from_the_egos_seat():
    assert [paths()["own", "straight"].lane_role(arc) for arc in (99.0, 101.0, 123.0)] == [
        "approach-own",
        "junction",
        "exit-ahead",
    ]
    after = ARM_M + 23.0
    assert paths()["left", "straight"].lane_role(after) == "exit-right"
    assert paths()["right", "straight"].lane_role(after) == "exit-left"
    assert paths()["oncoming", "straight"].lane_role(after) == "exit-own"
    assert paths()["oncoming", "left"].lane_role(after) == "exit-right"
    assert paths()["own", "left"].lane_role(after) == "exit-left"


@pytest.mark.parametrize("name", scenarios.names())
def test_the_nearest_point_of_a_path_is_found_where_it_bends_and_where_it_does_not(
    name: str,
) -> None:
    draws = np.random.default_rng(0)
    for path in scenarios.get(name).road().paths.values():
        between = (path.points[1:] + path.points[:-1])[
            draws.integers(len(path.points) - 1, size=50)
        ] / 2
        x, y = np.concatenate([draws.normal(0, 80, (200, 2)), between, path.points[[0, -1]]]).T
        gaps = np.hypot(path.columns[0] - x[:, None], path.columns[1] - y[:, None])
        nearest = gaps.argmin(axis=1)
        heading = path.headings_rad[nearest]
        along = (x - path.columns[0][nearest]) * np.cos(heading)
        along += (y - path.columns[1][nearest]) * np.sin(heading)
        arc, _, found = path.project_all(x, y)
        assert np.array_equal(found, heading)
        assert np.array_equal(arc, path.arc_m[nearest] + along)
