"""The scenario's draws: declared shares, ids that tell nothing, one draw a quantity."""

from collections import Counter
from dataclasses import replace

import pytest

from harness.core.errors import UserError
from harness.world import scenarios
from harness.world.crossroads import SECTORS, road
from harness.world.scenarios.occluded_intersection import NAME, SCENARIO, Parameters, layout

P = Parameters()


@pytest.fixture(scope="module")
def layouts():
    return [layout(seed, P) for seed in range(2000)]


def others(found):
    """Vehicles that neither decide nor help, by what they do: no two of a layout do the same."""
    return {(s.kind, s.approach, s.route, s.id == found.danger_id): s for s in found.spawns[4:]}


def test_the_registry_knows_the_scenario_by_its_files_name():
    assert scenarios.names() == (NAME,)
    assert scenarios.get(NAME) is SCENARIO
    assert SCENARIO.name == NAME


def test_an_unknown_scenario_is_an_error_that_names_the_nearest():
    with pytest.raises(UserError, match=r"unknown scenario 'ocluded-intersection'; did you mean"):
        scenarios.get("ocluded-intersection")


def test_dangers_come_as_often_and_from_where_the_parameters_say(layouts):
    sectors = Counter(found.danger for found in layouts)
    dangerous = len(layouts) - sectors[None]
    assert dangerous / len(layouts) == pytest.approx(P.danger_share, abs=0.033)  # three standard errors
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
            assert P.danger_offset_s[0] <= danger_s - ego_s <= P.danger_offset_s[1]


def test_an_oncoming_danger_follows_a_truck_close_enough_to_hide_behind_it(layouts):
    for found in layouts:
        if found.danger == "oncoming":
            danger = next(s for s in found.spawns if s.id == found.danger_id)
            truck = next(s for s in found.spawns if s.kind == "truck")
            assert truck.arc_m - danger.arc_m == pytest.approx(10.5)
            assert truck.speed_mps == danger.speed_mps


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


def test_taking_the_danger_out_leaves_every_other_id_and_the_buildings():
    for seed in range(300):
        with_danger, without = layout(seed, P), layout(seed, replace(P, danger_share=0.0))
        assert with_danger.buildings == without.buildings
        assert with_danger.spawns[:4] == without.spawns[:4]
        late = {k: v for k, v in others(with_danger).items() if k[0] == "car" and not k[3]}
        assert late == {k: v for k, v in others(without).items() if k[0] == "car"}
        trucks = [[s.id for s in f.spawns if s.kind == "truck"] for f in (with_danger, without)]
        assert not all(trucks) or trucks[0] == trucks[1]


def test_one_dial_moves_one_thing():
    for seed in range(50):
        slow, fast = (layout(seed, replace(P, late_speed_mps=(v, v))) for v in (7.0, 9.0))
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
