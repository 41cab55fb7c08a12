"""Beacons: what the ego and the helpers know of each other, played by hand."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from former import NAME, SCENARIO
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from together import act_together

from harness.core.errors import UserError
from harness.dataset.freeze import record_of
from harness.world import scenarios
from harness.world.beacons import Stretch, broadcast, last_heard, state_by_beacon
from harness.world.perception.graph import scene_graph
from harness.world.state import Beacon, Snapshot, WorldState
from harness.world.world import World

SILENT: Any = {"beacon_noise_m": 0.0, "beacon_noise_mps": 0.0, "beacon_noise_rad": 0.0}
EXACT = replace(SCENARIO, parameters=replace(SCENARIO.parameters, beacon_loss=0.0, **SILENT))
PERFECT = replace(SCENARIO, parameters=replace(SCENARIO.parameters, perfect_knowledge=True))
HELPERS = ("v2", "v3", "v4")
RADIO = "beacon_channel=its-g5+density_per_km=120+rate_hz=25"


def with_loss(loss):
    return replace(SCENARIO, parameters=replace(SCENARIO.parameters, beacon_loss=loss))


def ages_s(scenario, seeds, step=1):
    """Ages of the ego's beacons that its helpers have at a decision."""
    worlds = [World.start(scenario, seed) for seed in seeds]
    for _ in range(step):
        act_together(worlds, ["IDLE"] * len(worlds))
    for world in worlds:
        state = world.state()
        yield from (state.time_s - last_heard(state, "v1", helper).time_s for helper in HELPERS)


def test_who_drives_on_at_constant_speed_is_where_the_last_beacon_says():
    """The ego cruises, so dead reckoning is right to the centimetre in which beacons are said."""
    world = World.start(EXACT, 0)
    for _ in range(3):
        state = world.state()
        for sender, receiver in (("v1", "v2"), ("v1", "v4"), ("v2", "v1"), ("v3", "v1")):
            there, truth = state_by_beacon(state, sender, receiver), state.vehicle(sender)
            assert (there.x_m, there.y_m) == pytest.approx((truth.x_m, truth.y_m), abs=0.03)
            assert there.speed_mps == pytest.approx(truth.speed_mps, abs=0.005)
        world.act("IDLE")


def test_who_brakes_is_taken_to_drive_on_until_the_next_beacon():
    """The ego brakes at 8 m/s² from 14 m/s.
    What was said 20 to 120 ms ago has it too fast and too far.
    """
    world = World.start(EXACT, 0)
    world.take("SLOWER")
    world.advance(25)
    state = world.state()
    for helper in HELPERS:
        there, beacon = state_by_beacon(state, "v1", helper), last_heard(state, "v1", helper)
        age_s = state.time_s - beacon.time_s
        assert 0.02 - 1e-9 <= age_s <= 0.12
        assert there.speed_mps > state.ego.speed_mps
        assert there.y_m < state.ego.y_m, "farther north"
        assert there.y_m == pytest.approx(beacon.y_m - beacon.speed_mps * age_s, abs=0.02)
        assert beacon.target_speed_mps == 7.0
    assert state_by_beacon(state, "v1", "v1") == state.ego


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


@pytest.mark.slow
def test_losses_make_what_is_known_older():
    """Without losses the mean age is some 70 ms;
    each loss adds 100 ms, .08 + .08² + … of them on average.
    """
    seeds = range(60)
    least, usual, most = (list(ages_s(with_loss(loss), seeds)) for loss in (0.0, 0.08, 0.5))
    assert max(least) <= 0.12 + 1e-9
    assert sum(usual) / len(usual) == pytest.approx(
        sum(least) / len(least) + 0.1 * 0.08 / 0.92, abs=0.008
    )
    assert sum(most) / len(most) == pytest.approx(sum(least) / len(least) + 0.1, abs=0.03)
    assert all(more >= less - 1e-9 for more, less in zip(most, usual, strict=True)), (
        "the draws are shared"
    )


@pytest.mark.slow
def test_a_beacon_says_the_same_to_all_and_its_errors_are_those_declared():
    errors = []
    for seed in range(150):
        state = World.start(SCENARIO, seed).state()
        for beacon in state.beacons:
            if beacon.sender == "v1":
                truth = (
                    World.start(replace(SCENARIO, parameters=EXACT.parameters), seed).state().ego
                )
                errors.append(beacon.x_m - truth.x_m)
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) == pytest.approx(0.2, rel=0.2)


DIALS = (
    "beacon_loss=0",
    "beacon_loss=0.08",
    "beacon_loss=0.7",
    "beacon_rule=cam,beacon_loss=0.7",
    RADIO,
)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.lists(st.integers(1, 60), max_size=4), st.sampled_from(DIALS))
def test_beacons_do_not_depend_on_how_time_is_cut(frames, dials):
    """Nor on a freeze: a world that was thawed at every stop knows the same."""
    scenario = scenarios.get(f"occluded-intersection:{dials}")
    whole, cut = World.start(scenario, 3), World.start(scenario, 3)
    for frame in sorted(frames):
        cut.advance(frame)
        text = msgspec.json.encode((cut.state(), cut.snapshot()))
        cut = World.thaw(scenario, *msgspec.json.decode(text, type=tuple[WorldState, Snapshot]))
    end = max(frames, default=0) + 7
    for frame in (end // 2, end - 3, end):  # nobody asks in between
        whole.advance(frame)
    cut.advance(end)
    # A state is kept to the micrometre, a beacon to a centimetre.
    assert [structs.replace(b, x_m=0.0, y_m=0.0) for b in cut.state().beacons] == [
        structs.replace(b, x_m=0.0, y_m=0.0) for b in whole.state().beacons
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
    ego, helper = (scene_graph(seldom, state, viewer).ego for viewer in ("v1", "v2"))
    beacon = last_heard(state, "v1", "v2")
    assert (ego.age_s, ego.speed_mps) == (0.0, round(state.ego.speed_mps, 1))
    assert helper.age_s == pytest.approx(state.time_s - beacon.time_s)
    assert helper.speed_mps == round(beacon.speed_mps, 1) > ego.speed_mps
    assert helper.zone_m < ego.zone_m


def test_weights_and_ranges_are_from_the_beacons_that_the_ego_heard():
    world = World.start(SCENARIO, 1)
    world.act("IDLE")
    state = world.state()
    record = record_of(world, state, 0, (state.ego, *state.helpers))
    zone = SCENARIO.road().zone_m
    for helper in HELPERS:
        there, truth = state_by_beacon(state, helper, "v1"), state.vehicle(helper)
        distance_m = math.hypot(there.x_m - zone[0], there.y_m - zone[1])
        range_m = math.hypot(there.x_m - state.ego.x_m, there.y_m - state.ego.y_m)
        assert record.distance_m[helper] == pytest.approx(distance_m, abs=0.001)
        assert record.range_m[helper] == pytest.approx(range_m, abs=0.001)
        assert (there.x_m, there.y_m) != (truth.x_m, truth.y_m)
    ego = state.ego
    assert record.distance_m["v1"] == round(math.hypot(ego.x_m - zone[0], ego.y_m - zone[1]), 3)


def test_under_perfect_knowledge_nobody_broadcasts_and_everybody_knows_the_truth():
    world = World.start(PERFECT, 0)
    world.act("SLOWER")
    state = world.state()
    assert state.beacons == ()
    assert state_by_beacon(state, "v1", "v2") == state.ego
    assert scene_graph(PERFECT, state, "v2").ego.age_s == 0.0
    there = World.start(SCENARIO, 0)
    there.act("SLOWER")
    assert structs.replace(there.state(), beacons=()) == state, "beacons move nobody"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("beacon_loss=1", "beacon_loss is 1.0; it must be a probability from 0, below 1"),
        ("beacon_hz=0", "beacon_hz is 0.0; it must be above 0, at most 50"),
        ("beacon_hz=nan", "beacon_hz is nan; it must be above 0"),
        ("beacon_delay_s=-0.1", "beacon_delay_s is -0.1; it must be seconds from 0 to 1"),
        ("perfect_knowledge=2", "perfect_knowledge is '2'; give true or false"),
        ("beacon_noise_m=much", "beacon_noise_m is 'much'; give a number"),
        (
            "beacon_los=0.1",
            "unknown setting of scenario occluded-intersection 'beacon_los'; did you mean",
        ),
        ("danger_share=0.5", "unknown setting of scenario occluded-intersection 'danger_share'"),
        ("beacon_rule=often", "beacon_rule is often; it must be fixed or cam"),
        (
            "beacon_channel=v2x",
            "beacon_channel is v2x, which has one loss for all links; it must be a physical",
        ),
        ("beacon_channel=its-g6", "unknown beacon_channel 'its-g6'; did you mean 'its-g5'?"),
        ("beacon_channel=its-g5+density=3", "unknown setting of beacon_channel its-g5 'density'"),
        ("", "unknown setting of scenario occluded-intersection ''"),
    ],
)
def test_a_scenario_may_be_named_with_other_beacons_that_are_allowed(text, says):
    changed = scenarios.get(
        "occluded-intersection:beacon_loss=0.5,perfect_knowledge=true"
    ).parameters
    assert (changed.beacon_loss, changed.perfect_knowledge) == (0.5, True)
    with pytest.raises(UserError) as refused:
        scenarios.get(f"occluded-intersection:{text}")
    assert says in str(refused.value)


@pytest.mark.parametrize("hz", [1.0, 3.0, 50.0])
def test_any_rate_up_to_one_a_frame_has_everybody_heard_at_the_start(hz):
    scenario = scenarios.get(f"{NAME},beacon_hz={hz},beacon_delay_s=0.1,beacon_loss=0")
    for seed in range(8):
        world = World.start(scenario, seed)
        for frame in (0, 1, 37):
            world.advance(frame)
            state = world.state()
            ages = [state.time_s - last_heard(state, "v1", helper).time_s for helper in HELPERS]
            assert all(0.1 - 1e-9 <= age <= 0.1 + 1 / hz + 0.02 for age in ages)


# -- CAM: sent as the vehicle moves ----------------------------------------------------------------


def cams(scenario, speeds_mps, turn_rad=0.0):
    """Frames of one ego's CAMs that drives at these speeds, frame by frame,
    from the first in them.
    """
    heard, frames = tuple[Beacon, ...](), []
    x_m = heading_rad = 0.0
    for frame, speed in enumerate(speeds_mps):
        x_m += speed / 50
        heading_rad += turn_rad / 50
        poses = np.array([[[x_m, 0.0, heading_rad, speed], [x_m, 9.0, 0.0, speed]]])
        driven = Stretch(poses, frame, 14.0, lambda _: np.zeros(1))
        heard = broadcast(scenario.parameters, 0, heard, ("v1", "v2"), [driven])
        frames += [round(50 * b.time_s) for b in heard if b.sender == "v1"][-1:]
    return [frame for n, frame in enumerate(frames) if frame not in frames[:n]]


CAM = replace(EXACT, parameters=replace(EXACT.parameters, beacon_rule="cam", beacon_delay_s=0.0))


@pytest.mark.parametrize(
    ("speed_mps", "every_s"),
    [(0.0, 1.0), (3.0, 1.0), (7.0, 0.6), (14.0, 0.3), (30.0, 0.2), (45.0, 0.1)],
)
def test_a_steady_vehicle_sends_when_a_check_finds_it_four_metres_on_and_once_a_second_at_least(
    speed_mps, every_s
):
    """At 14 m/s 4 m take 286 ms, and the third check finds them;
    at 3 m/s the second is over before.
    """
    sent = cams(CAM, [speed_mps] * 250)
    assert set(np.diff(sent)) == {round(50 * every_s)}


def test_who_turns_sends_every_four_degrees():
    """40° a second at a standstill: 4° are passed at the second check."""
    assert set(np.diff(cams(CAM, [0.0] * 200, math.radians(25)))) == {10}


def test_who_brakes_sends_at_every_check_three_times_more_after_it_and_then_by_distance():
    """From 14 m/s to 3 m/s at 8 m/s²: 0.8 m/s a check. At 3 m/s 4 m take longer than a second."""
    speeds = [14.0] * 100 + [14.0 - 0.16 * k for k in range(1, 70)]
    sent = cams(CAM, speeds + [speeds[-1]] * 300)
    assert np.diff(sent).tolist() == [15] * 7 + [5] * 12 + [5] * 3 + [50] * 5
    assert sent[19] == 166, "the last check that finds it slower: it brakes until frame 168"


@pytest.mark.slow
def test_under_cam_a_lost_beacon_is_still_the_last_one_that_was_sent():
    """The next is measured from it, whoever heard it,
    so losses do not change when beacons are sent.
    """

    def times(loss):
        world = World.start(scenarios.get(f"{NAME},beacon_rule=cam,beacon_loss={loss}"), 0)
        world.take("SLOWER")
        found = set()
        for frame in range(1, 150):
            world.advance(frame)
            found |= {b.time_s for b in world.beacons if b.sender == "v1" and b.time_s > 0}
        return found

    assert times(0) == times(0.9)
    assert 5 < len(times(0)) < 30


# -- beacons over a radio --------------------------------------------------------------------------


def heard(dials, seeds=range(3)):
    """When what each has heard of the other was sent, at each of three decisions."""
    scenario = scenarios.get(f"{NAME},{dials}")
    found, worlds = {}, [World.start(scenario, seed) for seed in seeds]
    for step in range(3):
        for world in worlds:
            state = world.state()
            for helper in HELPERS:
                for way in (("v1", helper), (helper, "v1")):
                    found[world.seed, step, *way] = last_heard(state, *way).time_s
        act_together(worlds, ["IDLE"] * len(worlds))
    return found


@pytest.mark.slow
def test_on_a_strong_radio_beacons_get_through_and_on_a_feeble_one_only_the_first_does():
    strong = heard("beacon_channel=its-g5+density_per_km=0+power_dbm=60")
    feeble = heard("beacon_channel=its-g5+power_dbm=-60")
    assert strong == heard("beacon_loss=0.001")
    assert all(time_s < -0.8 for time_s in feeble.values())


@pytest.mark.slow
def test_a_busier_channel_never_makes_anybody_hear_more():
    """The draws are shared, and so is the shadowing."""
    quiet, busy = (
        heard(f"beacon_channel=its-g5+density_per_km={density}") for density in (10, 150)
    )
    assert all(busy[key] <= quiet[key] for key in quiet)
    assert busy != quiet


def test_an_environments_vehicles_beacon_over_a_radio_too():
    dials = "beacon_rule=cam,beacon_channel=its-g5+density_per_km=200+rate_hz=20"
    world = World.start(scenarios.get(f"env:merge-v0:{dials}"), 3)
    world.act("IDLE")
    state = world.state()
    assert state.helpers
    assert all(
        0.02 <= state.time_s - last_heard(state, h.id, "v1").time_s <= 1.5 for h in state.helpers
    )


@pytest.mark.slow
def test_the_loss_of_a_beacon_is_that_of_its_link_when_it_was_sent():
    """Where the radio says .3 for one link and 1 for the others, its share comes,
    and nothing else.
    """
    p, n = SCENARIO.parameters, 1000
    poses = np.zeros((5, 3, 4))
    came = 0
    for seed in range(n):
        driven = Stretch(poses, 100, 14.0, lambda _: np.array([0.3, 1.0]))
        sent = broadcast(p, seed, (), ("v1", "v2", "v3"), [driven])
        came += sum(b.heard_by == ("v2",) for b in sent if b.sender == "v1")
        assert not any("v3" in b.heard_by or b.sender == "v3" for b in sent), (
            "the link fails both ways"
        )
    assert came / n == pytest.approx(0.7, abs=0.04)


@pytest.mark.exhaustive
def test_times_between_beacons_that_get_through_are_geometric():
    """Mean T / p; the share q is reached after ceil(log(1 - q) / log(1 - p)) periods:
    3 at .95 and p = .7.
    """
    p, gaps = replace(SCENARIO.parameters, beacon_loss=0.3), []
    poses = np.zeros((1, 2, 4))
    for seed in range(40):
        before, times = tuple[Beacon, ...](), []
        for frame in range(450):
            driven = Stretch(poses, frame, 0.0, lambda _: np.array([0.3]))
            before = broadcast(p, seed, before, ("v1", "v2"), [driven])
            times += [
                b.time_s
                for b in before
                if b.sender == "v1" and b.heard_by and b.time_s not in times
            ]
        gaps += np.diff(times).tolist()
    assert np.mean(gaps) == pytest.approx(0.1 / 0.7, rel=0.03)
    assert np.quantile(gaps, 0.95) == pytest.approx(
        0.1 * math.ceil(math.log(0.05) / math.log(0.3)), abs=0.001
    )


def test_dials_that_are_as_before_are_not_stated_so_that_what_was_built_stays_as_it_is():
    stated = SCENARIO.parameters.stated()
    assert not {"beacon_rule", "beacon_channel"} & set(stated)
    changed = scenarios.get(f"occluded-intersection:beacon_rule=cam,{RADIO}")
    assert changed.parameters.stated()["beacon_channel"] == "its-g5+density_per_km=120+rate_hz=25"
    assert scenarios.of_manifest("occluded-intersection", changed.parameters.stated()) == changed
    assert "interval_s" not in msgspec.to_builtins(World.start(SCENARIO, 0).state())["beacons"][0]
