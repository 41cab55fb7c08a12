"""The scenario's draws: declared shares, ids that tell nothing, one draw a quantity."""

from collections import Counter
from dataclasses import replace

import former
import numpy as np
import pytest
from together import go_on_together

from harness.core.errors import UserError
from harness.world import scenarios
from harness.world.crossroads import SECTORS, road
from harness.world.scenarios.occluded_intersection import NAME, SCENARIO, behind_truck_s, layout
from harness.world.world import World

P = former.SCENARIO.parameters


@pytest.fixture(scope="module")
def layouts():
    return [layout(seed, P) for seed in range(2000)]


def test_the_registry_knows_the_scenario_by_its_files_name():
    assert NAME in scenarios.names()
    assert scenarios.get(NAME) is SCENARIO
    assert SCENARIO.name == NAME


def test_an_unknown_scenario_is_an_error_that_names_the_nearest():
    with pytest.raises(UserError, match=r"unknown scenario 'ocluded-intersection'; did you mean"):
        scenarios.get("ocluded-intersection")


def test_dangers_come_as_often_and_from_where_the_parameters_say(layouts):
    sectors = Counter(found.danger for found in layouts)
    dangerous = len(layouts) - sectors[None]
    # three standard errors
    assert dangerous / len(layouts) == pytest.approx(P.danger_share, abs=0.033)
    for sector, share in zip(SECTORS, P.sector_shares, strict=True):
        assert sectors[sector] / dangerous == pytest.approx(share, abs=0.045)


def test_the_dangerous_vehicle_comes_from_the_sector_it_is_said_to(layouts):
    for found in layouts:
        by_id = {s.id: s for s in found.spawns}
        if found.danger is None:
            assert found.danger_id is None
        else:
            assert by_id[found.danger_id].approach == found.danger
            assert by_id[found.danger_id].part == "other"


def test_a_danger_meets_a_cruising_ego_at_the_conflict_point_within_the_drawn_offset(layouts):
    for found in layouts:
        if found.danger_id:
            ego, danger = found.spawns[0], {s.id: s for s in found.spawns}[found.danger_id]
            at = road().crossings[danger.approach, danger.route]
            ego_s = (at.ego_arc_m - ego.arc_m) / ego.speed_mps
            danger_s = (at.other_arc_m - danger.arc_m) / danger.speed_mps
            least_s, most_s = (-1.1, -0.1) if found.danger == "oncoming" else P.danger_offset_s
            assert least_s <= danger_s - ego_s <= most_s


def test_an_oncoming_danger_follows_the_truck_close_enough_to_hide_behind_it(layouts):
    for found in layouts:
        if found.danger == "oncoming":
            danger = next(s for s in found.spawns if s.id == found.danger_id)
            truck = next(s for s in found.spawns if s.kind == "truck")
            assert P.follow_m[0] <= truck.arc_m - danger.arc_m <= P.follow_m[1]
            assert truck.speed_mps == danger.speed_mps


def test_there_is_one_truck_whatever_is_hidden(layouts):
    assert all(sum(s.kind == "truck" for s in found.spawns) == 1 for found in layouts)


def test_a_harmless_car_is_like_a_dangerous_one_but_late(layouts):
    late = {sector: [] for sector in SECTORS}
    dangerous = {sector: [] for sector in SECTORS}
    for found in layouts:
        ego, *cars = (s for s in found.spawns if s.kind == "car" and s.part != "helper")
        for car in cars:
            at = road().crossings[car.approach, car.route]
            after_s = (at.other_arc_m - car.arc_m) / car.speed_mps - (
                at.ego_arc_m - ego.arc_m
            ) / ego.speed_mps
            (dangerous if car.id == found.danger_id else late)[car.approach].append(car.speed_mps)
            if car.id != found.danger_id:
                assert P.late_offset_s[0] <= after_s <= P.late_offset_s[1]
    for sector in SECTORS:
        assert len(late[sector]) / len(layouts) == pytest.approx(P.late_share / 3, abs=0.025)
        bands = [np.quantile(of[sector], [0.05, 0.5, 0.95]) for of in (late, dangerous)]
        assert bands[0] == pytest.approx(bands[1], abs=0.25)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seeds", [range(6), pytest.param(range(6, 60), marks=pytest.mark.exhaustive)]
)
def test_nobody_touches_anybody_before_the_ego_does(seeds):
    worlds = [World.start(SCENARIO, seed) for seed in seeds]
    go_on_together(worlds, "IDLE")
    assert all(world.ended and world.outcome.other_crashes == 0 for world in worlds)


def test_a_car_from_the_left_passes_just_behind_the_truck_or_later():
    """The truck's centre is where their lanes cross after 4 s.

    Its tail is off the car's way 6 m later, 0.75 s at 8 m/s. The car is on the truck's way from 3.8
    m before, 0.38 s at 10 m/s, with 0.15 s to spare, and meets the ego 4 m on.
    """
    at = road().crossings["left", "straight"]
    here = road().paths["oncoming", "straight"].project(-2.0, at.y_m)[0]
    assert behind_truck_s("left", 10.0, here - 32.0, 8.0) == pytest.approx(
        4 + 0.75 + 0.38 + 0.15 + 0.4
    )


def test_ego_and_helpers_have_the_same_ids_in_every_episode(layouts):
    for found in layouts:
        assert [(s.id, s.part) for s in found.spawns[:4]] == [
            ("v1", "ego"), ("v2", "helper"), ("v3", "helper"), ("v4", "helper"),
        ]  # fmt: skip


def test_an_id_tells_nothing_about_who_else_is_there(layouts):
    alone, among = Counter(), Counter()
    for found in layouts:
        spawns = found.spawns[4:]
        (among if found.danger else alone).update(s.id for s in spawns if s.id != found.danger_id)
    for counts in (alone, among):
        for vehicle in ("v5", "v6", "v7"):
            assert counts[vehicle] / counts.total() == pytest.approx(1 / 3, abs=0.05)


@pytest.mark.slow
def test_whatever_is_not_the_danger_is_where_it_would_be_without_it():
    for seed in range(300):
        with_danger, without = layout(seed, P), layout(seed, replace(P, danger_share=0.0))
        assert with_danger.buildings == without.buildings
        assert with_danger.spawns[:4] == without.spawns[:4]
        assert {s for s in with_danger.spawns if s.id != with_danger.danger_id} == set(
            without.spawns
        )


def test_one_dial_moves_one_thing():
    for seed in range(50):
        slow, fast = (layout(seed, replace(P, crossing_speed_mps=(v, v))) for v in (7.0, 9.0))
        assert slow.buildings == fast.buildings
        assert slow.danger_id == fast.danger_id
        assert [s.id for s in slow.spawns] == [s.id for s in fast.spawns]


def test_buildings_leave_the_road_free_and_stand_one_a_corner(layouts):
    for found in layouts[:200]:
        corners = {(b.west_m > 0, b.north_m > 0) for b in found.buildings}
        assert len(corners) == 4
        for b in found.buildings:
            nearest = min(map(abs, (b.west_m, b.east_m))), min(map(abs, (b.north_m, b.south_m)))
            assert all(P.corner_m[0] <= distance <= P.corner_m[1] for distance in nearest)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"simulation_hz": 1e9}, "simulation_hz is 1000000000; it must be from 1 to 1000"),
        ({"simulation_hz": 0.5}, "simulation_hz = 0.5; allowed: a whole number"),
        (
            {"time_limit_s": 1e9},
            "time_limit_s is 1000000000.0; it must be above 0, and 20000 frames at most",
        ),
        (
            {"time_limit_s": 1e3},
            "time_limit_s is 1000.0; it must be above 0, and 20000 frames at most",
        ),
        ({"time_limit_s": float("nan")}, "time_limit_s is nan"),
        ({"decisions": 10**9}, "decisions is 1000000000; it must be from 1 to 10"),
        ({"decision_period_s": 0}, "decision_period_s is 0.0; it must be seconds above 0"),
        ({"danger_share": 2}, "danger_share is 2.0; it must be from 0 to 1"),
        ({"danger_share": "0.5"}, "danger_share = '0.5'; allowed: a number"),
        ({"ego_start_m": [1]}, "ego_start_m = [1]; allowed: a list of length 2"),
        ({"ego_start_m": [1, "x"]}, "[ego_start_m]: 1 = 'x'; allowed: a number"),
        (
            {"ego_start_m": [1, 1e9]},
            "ego_start_m is (1.0, 1000000000.0); it must be from -1000 to 1000",
        ),
        ({"ego_speed_mps": 0.0}, "ego_speed_mps is 0.0; it must be from 0.1 to 200"),
        ({"target_speeds_mps": []}, "target_speeds_mps is (); it must be 1 to 20 speeds"),
        ({"target_speeds_mps": [1] * 10_000}, "it must be 1 to 20 speeds"),
        ({"ambient": ["day"]}, "ambient = ['day']; allowed: a text"),
        (
            {"beacon_channel": "mode4+power_dbm=1e9"},
            "mode4: power_dbm = 1000000000.0; allowed: a number from",
        ),
        ({"of_another": 1}, "has other parameters here (not of_another)"),
    ],
)
def test_a_parameter_that_a_file_states_has_a_type_and_bounds(stated, said):
    with pytest.raises(UserError) as refused:
        scenarios.of_manifest(NAME, stated)
    assert said in str(refused.value)
    assert str(refused.value).isprintable()


def test_what_a_scenario_states_is_read_back_as_it_was():
    for name in scenarios.names():
        scenario = scenarios.get(name)
        stated = {
            k: float(v) if type(v) is int else v for k, v in scenario.parameters.stated().items()
        }
        assert scenarios.of_manifest(name, stated) == scenario
