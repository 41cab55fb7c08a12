"""What stands between two antennas, and the shadowing between places."""

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Draws
from harness.radio.fading import Trips
from harness.world.scenario import Names
from harness.world.sight_lines import corners, site
from harness.world.state import Building, VehicleState, WorldState


def vehicle(
    name: str, x_m: float, y_m: float, heading_rad: float = 0.0, kind: str = "car"
) -> VehicleState:
    part = {"v1": "ego"}.get(name, "helper")
    return VehicleState(name, kind, part, x_m, y_m, heading_rad, 8.0, "west", "straight", False)  # type: ignore[arg-type]


def state(*vehicles: VehicleState, buildings: tuple[Building, ...] = ()) -> WorldState:
    return WorldState("any", 0, 0, 0.0, 8.0, vehicles, buildings)


EGO = vehicle("v1", 0, 0)
NARROW = ("bicycle", "motorcycle", "pedestrian")


def test_a_truck_between_two_vehicles_hides_them_a_wall_more_so_and_what_is_beside_the_line_does_not():
    truck, beside = vehicle("v9", 20, 0.5, kind="truck"), vehicle("v8", 20, 4)
    wall = Building("b1", 35, -5, 36, 5)
    ahead, behind = vehicle("v2", 40, 0), vehicle("v3", -30, 0)
    links = site([
        (state(EGO, ahead, behind, truck, beside), ["v1", "v2", "v3"]),
        (state(EGO, ahead, truck, buildings=(wall,)), ["v1", "v2"]),
        (state(EGO, ahead), ["v1", "v2"]),
    ])  # fmt: skip
    assert links.sight.tolist() == [[VEHICLE, CLEAR], [BUILDING, CLEAR], [CLEAR, CLEAR]]
    assert links.blocker_m.tolist() == [[3.6, 0], [3.6, 0], [0, 0]]
    assert links.distance_m[0].tolist() == [40, 30]
    assert np.isnan(links.distance_m[1, 1]), "no second helper there"
    assert links.take([2, 0]).xy_m[1, 2].tolist() == [-30, 0]


def test_many_points_at_once_are_each_alone():
    """With vehicles and buildings drawn, in states that differ in size, one of which comes twice."""
    rng, points = np.random.default_rng(4), []
    for n in (2, 9, 20, 3, 12):
        x_m, y_m, heading_rad = rng.uniform(-40, 40, (3, n)).tolist()
        kinds = rng.choice(["car", "truck", "bicycle"], n).tolist()
        vehicles = []
        for k in range(n):
            vehicles.append(vehicle(f"v{k + 1}", x_m[k], y_m[k], heading_rad[k], kinds[k]))
        walls = [Building(f"b{k}", 12.0 * k, -9, 12.0 * k + 8, 9) for k in range(1, n // 2)]
        points.append((state(*vehicles, buildings=tuple(walls)), ["v1", "v2", f"v{n}"]))
    points.append((points[1][0], ["v3", "v2"]))
    together = site(points)
    assert {CLEAR, VEHICLE, BUILDING} == set(together.sight.ravel().tolist())
    for n, point in enumerate(points):
        alone, h = site([point]), len(point[1])
        assert np.array_equal(together.xy_m[n, :h], alone.xy_m[0])
        for name in ("sight", "blocker_m", "corner_m"):
            here = getattr(together, name)[n, : h - 1]
            assert np.array_equal(here, getattr(alone, name)[0], equal_nan=True), name


def test_who_is_narrow_blocks_no_radio():
    ahead = vehicle("v2", 40, 0)
    riders = [vehicle(f"v{n}", 10 * n - 20, 0, kind=k) for n, k in enumerate(NARROW, 3)]
    links = site([(state(EGO, ahead, *riders), ["v1", "v2"])])
    assert (links.sight.tolist(), links.blocker_m.tolist()) == ([[CLEAR]], [[0]])


def test_vehicles_have_the_names_and_the_clock_of_their_traffics_source():
    ahead = vehicle("v2", 40, 0)
    points = [(state(EGO, ahead), ["v1", "v2"]), (state(EGO), ["v1"])]
    links = site(points, names=[Names(60.5, {"v1": "car.7", "v2": "bus"}), None])
    assert links.names.tolist() == [["car.7", "bus"], ["", ""]]
    assert links.time_s.tolist() == pytest.approx([60.5, np.nan], nan_ok=True)
    assert links.take([0]).of_helpers(np.array([[0, 0]])).names.tolist() == [
        ["car.7", "bus", "bus"]
    ]
    assert site(points).names is None


def test_streets_cross_where_the_lines_along_the_headings_do():
    right, left = vehicle("v2", 30, 40, np.pi / 2), vehicle("v3", 30, -40, np.pi / 2)
    beside = vehicle("v4", 30, 4, np.pi)
    crossing = corners([(EGO, right), (left, EGO), (EGO, beside)])
    assert crossing[:2].tolist() == [pytest.approx([30, 40]), pytest.approx([40, 30])]
    assert np.isnan(crossing[2]).all(), "side by side"


def trips(seeds: int, steps: int = 6) -> Trips:
    seed = np.arange(seeds)
    return Trips(seed, np.full(seeds, 7), np.zeros(seeds, dtype=int), steps)


@pytest.mark.slow
def test_shadowing_is_normal_and_forgets_with_the_distance_moved():
    n, decorrelation_m = 8_000, 10.0
    here = np.broadcast_to([[0.0, 0.0], [50.0, 10.0]], (n, 2, 2))
    start = trips(n).shadow(here, decorrelation_m)[:, 0]
    assert start.mean() == pytest.approx(0, abs=0.03)
    assert start.std() == pytest.approx(1, abs=0.02)
    for ego_m, helper_m in ((5, 0), (0, 10), (6, 8)):
        moved = here + np.array([[ego_m, 0], [0, helper_m]])
        later = trips(n).shadow(moved, decorrelation_m)[:, 0]
        expected = np.exp(-np.hypot(ego_m, helper_m) / decorrelation_m)
        assert np.corrcoef(start, later)[0, 1] == pytest.approx(expected, abs=0.03)


def test_a_trips_draws_are_its_own_whoever_else_is_asked_for():
    many = Trips(np.array([1, 2, 2]), np.array([5, 5, 6]), np.array([0, 3, 3]), 6)
    xy = np.random.default_rng(0).uniform(-50, 50, (3, 4, 2))
    for n in range(3):
        alone = many.take(n)
        assert np.array_equal(alone.shadow(xy[n], 10.0), many.shadow(xy, 10.0)[n])
        assert np.array_equal(alone.shadow(xy[n, :3], 10.0), many.shadow(xy, 10.0)[n, :2]), (
            "fewer helpers"
        )
        assert np.array_equal(alone.uniforms(2), many.uniforms(3)[n, :5])
    draws = Draws(np.zeros((3, 3, 2)), np.zeros((3, 3)), many)
    assert draws.packet.shape == (3, 3, 2)
    assert draws.wait.shape == (3,)
    assert np.array_equal(draws.take([2]).packet[0], draws.packet[2])


def test_a_world_without_places_has_no_physical_radio():
    with pytest.raises(UserError, match="the paper's study has none"):
        Draws(np.zeros((1, 3, 2)), np.zeros((1, 3))).wait  # noqa: B018
