"""Beacons: what the ego and the helpers know of each other, played by hand."""

import json
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.core.errors import UserError
from harness.dataset.freeze import moment
from harness.world import scenarios
from harness.world.beacons import known, last_heard
from harness.world.perception.graph import scene_graph
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.state import WorldState
from harness.world.world import World

SILENT: Any = {"beacon_noise_m": 0.0, "beacon_noise_mps": 0.0, "beacon_noise_rad": 0.0}
EXACT = replace(SCENARIO, parameters=replace(SCENARIO.parameters, beacon_loss=0.0, **SILENT))
PERFECT = replace(SCENARIO, parameters=replace(SCENARIO.parameters, perfect_knowledge=True))
HELPERS = ("v2", "v3", "v4")


def with_loss(loss):
    return replace(SCENARIO, parameters=replace(SCENARIO.parameters, beacon_loss=loss))


def ages_s(scenario, seeds, step=1):
    """Ages of the ego's beacons that its helpers have at a decision."""
    for seed in seeds:
        world = World.start(scenario, seed)
        for _ in range(step):
            world.act("IDLE")
        state = world.state()
        yield from (state.time_s - last_heard(state, "v1", helper).time_s for helper in HELPERS)


def test_who_drives_on_at_constant_speed_is_where_the_last_beacon_says():
    """The ego cruises, so dead reckoning is right to the centimetre in which beacons are said."""
    world = World.start(EXACT, 0)
    for _ in range(3):
        state = world.state()
        for sender, receiver in (("v1", "v2"), ("v1", "v4"), ("v2", "v1"), ("v3", "v1")):
            there, truth = known(state, sender, receiver), state.vehicle(sender)
            assert (there.x_m, there.y_m) == pytest.approx((truth.x_m, truth.y_m), abs=0.03)
            assert there.speed_mps == pytest.approx(truth.speed_mps, abs=0.005)
        world.act("IDLE")


def test_who_brakes_is_taken_to_drive_on_until_the_next_beacon():
    """The ego brakes at 8 m/s² from 14 m/s. What was said 20 to 120 ms ago has it too fast and too far."""
    world = World.start(EXACT, 0)
    world.take("SLOWER")
    world.advance(25)
    state = world.state()
    for helper in HELPERS:
        there, beacon = known(state, "v1", helper), last_heard(state, "v1", helper)
        age_s = state.time_s - beacon.time_s
        assert 0.02 - 1e-9 <= age_s <= 0.12
        assert there.speed_mps > state.ego.speed_mps
        assert there.y_m < state.ego.y_m, "farther north"
        assert there.y_m == pytest.approx(beacon.y_m - beacon.speed_mps * age_s, abs=0.02)
        assert beacon.target_speed_mps == 7.0
    assert known(state, "v1", "v1") == state.ego


def test_a_beacon_is_known_a_frame_after_it_was_sent():
    world = World.start(EXACT, 0)
    sent = 0
    for frame in range(1, 50):
        world.advance(frame)
        state = world.state()
        now = [b for b in state.beacons if (b.sender, b.time_s) == ("v1", state.time_s)]
        before = last_heard(state, "v1", "v2")
        assert before.time_s < state.time_s
        assert state.time_s - before.time_s <= 0.1 + 1e-9
        if now:
            sent += 1
            world.advance(frame + 1)
            assert last_heard(world.state(), "v1", "v2") == now[0]
    assert sent == 10, "a second, ten beacons"


def test_each_vehicle_begins_at_a_time_of_its_own_and_all_have_been_heard_at_the_start():
    phases = set()
    for seed in range(20):
        state = World.start(SCENARIO, seed).state()
        assert all(last_heard(state, "v1", h) and last_heard(state, h, "v1") for h in HELPERS)
        phases |= {round(last_heard(state, h, "v1").time_s % 0.1, 2) for h in HELPERS}
    assert len(phases) >= 5


def test_losses_make_what_is_known_older():
    """Without losses the mean age is some 70 ms; each loss adds 100 ms, .08 + .08² + … of them on average."""
    seeds = range(60)
    least, usual, most = (list(ages_s(with_loss(loss), seeds)) for loss in (0.0, 0.08, 0.5))
    assert max(least) <= 0.12 + 1e-9
    assert sum(usual) / len(usual) == pytest.approx(sum(least) / len(least) + 0.1 * 0.08 / 0.92, abs=0.008)
    assert sum(most) / len(most) == pytest.approx(sum(least) / len(least) + 0.1, abs=0.03)
    assert all(more >= less - 1e-9 for more, less in zip(most, usual, strict=True)), "the draws are shared"


def test_a_beacon_says_the_same_to_all_and_its_errors_are_those_declared():
    errors = []
    for seed in range(150):
        state = World.start(SCENARIO, seed).state()
        for beacon in state.beacons:
            if beacon.sender == "v1":
                truth = World.start(replace(SCENARIO, parameters=EXACT.parameters), seed).state().ego
                errors.append(beacon.x_m - truth.x_m)
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) == pytest.approx(0.2, rel=0.2)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 120), max_size=6), st.sampled_from((0.0, 0.08, 0.7)))
def test_beacons_do_not_depend_on_how_time_is_cut(frames, loss):
    """Nor on a freeze: a world that was thawed at every stop knows the same."""
    scenario = with_loss(loss)
    whole, cut = World.start(scenario, 3), World.start(scenario, 3)
    for frame in sorted(frames):
        cut.advance(frame)
        frozen = json.loads(json.dumps([cut.state().to_dict(), cut.snapshot()]))
        cut = World.thaw(scenario, WorldState.from_dict(frozen[0]), frozen[1])
    end = max(frames, default=0) + 7
    whole.advance(end)
    cut.advance(end)
    # A state is kept to the micrometre, a beacon to a centimetre.
    assert [replace(b, x_m=0.0, y_m=0.0) for b in cut.state().beacons] == [
        replace(b, x_m=0.0, y_m=0.0) for b in whole.state().beacons
    ]
    for mine, its in zip(cut.state().beacons, whole.state().beacons, strict=True):
        assert (mine.x_m, mine.y_m) == pytest.approx((its.x_m, its.y_m), abs=0.0101)


def test_a_helper_knows_the_ego_from_its_beacon_and_the_ego_knows_itself():
    seldom = replace(EXACT, parameters=replace(EXACT.parameters, beacon_hz=1.0))
    world = World.start(seldom, 0)
    world.take("SLOWER")
    world.advance(10)
    while world.time_s - last_heard(world.state(), "v1", "v2").time_s < 0.5:
        world.advance(world.frame + 1)
    state = world.state()
    ego, helper = (scene_graph(seldom, state, viewer)["ego"] for viewer in ("v1", "v2"))
    beacon = last_heard(state, "v1", "v2")
    assert (ego["age_s"], ego["speed_mps"]) == (0.0, round(state.ego.speed_mps, 1))
    assert helper["age_s"] == pytest.approx(state.time_s - beacon.time_s)
    assert helper["speed_mps"] == round(beacon.speed_mps, 1) > ego["speed_mps"]
    assert helper["zone_m"] < ego["zone_m"]


def test_weights_and_ranges_are_from_the_beacons_that_the_ego_heard():
    world = World.start(SCENARIO, 1)
    world.act("IDLE")
    state = world.state()
    record = moment(world, state, 0, (state.ego, *state.helpers))
    zone = SCENARIO.road().zone_m
    for helper in HELPERS:
        there, truth = known(state, helper, "v1"), state.vehicle(helper)
        distance_m = math.hypot(there.x_m - zone[0], there.y_m - zone[1])
        range_m = math.hypot(there.x_m - state.ego.x_m, there.y_m - state.ego.y_m)
        assert record["distance_m"][helper] == pytest.approx(distance_m, abs=0.001)
        assert record["range_m"][helper] == pytest.approx(range_m, abs=0.001)
        assert (there.x_m, there.y_m) != (truth.x_m, truth.y_m)
    ego = state.ego
    assert record["distance_m"]["v1"] == round(math.hypot(ego.x_m - zone[0], ego.y_m - zone[1]), 3)


def test_under_perfect_knowledge_nobody_broadcasts_and_everybody_knows_the_truth():
    world = World.start(PERFECT, 0)
    world.act("SLOWER")
    state = world.state()
    assert state.beacons == ()
    assert known(state, "v1", "v2") == state.ego
    assert scene_graph(PERFECT, state, "v2")["ego"]["age_s"] == 0.0
    there = World.start(SCENARIO, 0)
    there.act("SLOWER")
    assert replace(there.state(), beacons=()) == state, "beacons move nobody"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("beacon_loss=1", "beacon_loss is 1.0; it must be a probability from 0, below 1"),
        ("beacon_hz=0", "beacon_hz is 0.0; it must be above 0, at most 50"),
        ("beacon_hz=nan", "beacon_hz is nan; it must be above 0"),
        ("beacon_delay_s=-0.1", "beacon_delay_s is -0.1; it must be seconds from 0 to 1"),
        ("perfect_knowledge=2", "perfect_knowledge is 2.0; it must be true or false"),
        ("beacon_noise_m=much", "beacon_noise_m is 'much'; give a number"),
        ("beacon_los=0.1", "unknown setting of scenario occluded-intersection 'beacon_los'; did you mean"),
        ("danger_share=0.5", "unknown setting of scenario occluded-intersection 'danger_share'"),
        ("", "unknown setting of scenario occluded-intersection ''"),
    ],
)
def test_a_scenario_may_be_named_with_other_beacons_that_are_allowed(text, says):
    changed = scenarios.get("occluded-intersection:beacon_loss=0.5,perfect_knowledge=true").parameters
    assert (changed.beacon_loss, changed.perfect_knowledge) == (0.5, True)
    with pytest.raises(UserError) as refused:
        scenarios.get(f"occluded-intersection:{text}")
    assert says in str(refused.value)


@pytest.mark.parametrize("hz", [1.0, 3.0, 50.0])
def test_any_rate_up_to_one_a_frame_has_everybody_heard_at_the_start(hz):
    scenario = scenarios.get(f"occluded-intersection:beacon_hz={hz},beacon_delay_s=0.1,beacon_loss=0")
    for seed in range(8):
        world = World.start(scenario, seed)
        for frame in (0, 1, 37):
            world.advance(frame)
            state = world.state()
            ages = [state.time_s - last_heard(state, "v1", helper).time_s for helper in HELPERS]
            assert all(0.1 - 1e-9 <= age <= 0.1 + 1 / hz + 0.02 for age in ages)
