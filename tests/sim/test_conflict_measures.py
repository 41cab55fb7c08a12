"""Time to collision and post-encroachment time:
by hand, against a search through all pairs, and together.
"""

import numpy as np
import pytest
from former import SCENARIO
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tiers import QUICK

from harness.core.arrays import Floats
from harness.world import lockstep, scenarios
from harness.world.conflict_measures import (
    HORIZON_S,
    MOMENTS_HZ,
    Conflicts,
    columns,
    observe,
    times_to_collision,
)
from harness.world.state import separation_m
from harness.world.world import World

HZ = 10
CAR, TRUCK = (5.0, 2.0), (10.0, 2.6)
NORTH = -np.pi / 2
Pose = tuple[float, float, float, float]


LONG_S = 1e6  # rounding decides whether courses that are so alike ever meet
# lane changes, crossings, curves
FEW = ("do-not-pass", "occluded-intersection", "roundabout-entries")


def ttc_s(ego: Pose, other: Pose, sizes: tuple[tuple[float, float], ...] = (CAR, CAR)) -> float:
    poses, lengths = (np.array(each, dtype=float)[:, None] for each in ((ego, other), sizes))
    return float(times_to_collision(poses[0], lengths[0], poses[1], lengths[1])[0])


def driven(*tracks: Floats) -> Floats:
    """Some vehicles' poses, each (frames, 4), as those of one world."""
    return np.stack(tracks, axis=1)[None]


def straight(start: Pose, frames: int) -> Floats:
    """A vehicle that keeps its heading and speed from its pose in frame 0 on."""
    x, y, heading, speed = start
    t = np.arange(frames) / HZ
    track = np.stack(
        [x + speed * np.cos(heading) * t, y + speed * np.sin(heading) * t, 0 * t, 0 * t], axis=1
    )
    track[:, 2:] = heading, speed
    return track


def measured(
    poses: Floats, sizes: tuple[tuple[float, float], ...] = (CAR, CAR), parts: int = 1, hz: int = HZ
) -> Conflicts:
    conflicts, number = Conflicts(), 1
    for part in np.array_split(poses, parts, axis=1):
        [conflicts] = observe([conflicts], part, np.array([sizes]), np.array([number]), hz)
        number += part.shape[1]
    return conflicts


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        # on a line: from bumper to bumper by the closing speed
        ((25.0, 0.0, 0.0, 4.0), 20.0 / 6.0),
        ((25.0, 0.0, 0.0, 10.0), np.inf),  # as fast
        ((25.0, 0.0, 0.0, 12.0), np.inf),  # faster
        ((-25.0, 0.0, 0.0, 12.0), 20.0 / 2.0),  # it comes from behind
        ((25.0, 0.0, np.pi, 4.0), 20.0 / 14.0),  # it comes towards the ego
        ((25.0, 3.5, np.pi, 4.0), np.inf),  # in the next lane
        ((25.0, 3.5, 0.0, 0.0), np.inf),  # parallel, and passed
        # crossing: both bumpers are 16.5 m before the other's side
        ((20.0, 20.0, NORTH, 10.0), 1.65),
        ((20.0, 40.0, NORTH, 10.0), np.inf),  # crossing behind the ego
        ((20.0, 22.0, NORTH, 10.0), 1.85),  # it hits the ego's side: its bumper has 18.5 m
        ((4.0, 0.0, 0.0, 10.0), 0.0),  # they overlap
    ],
)
def test_time_to_collision_by_hand(other: Pose, expected: float) -> None:
    ego = (0.0, 0.0, 0.0, 10.0)
    assert ttc_s(ego, other) == pytest.approx(expected)
    assert ttc_s(other, ego) == pytest.approx(expected)


POSE = st.tuples(
    st.floats(-30, 30), st.floats(-30, 30), st.floats(-3.2, 3.2), st.floats(0, 15)
)  # fmt: skip


def moved(pose: Pose, seconds: float) -> Floats:
    x, y, heading, speed = pose
    return np.array(
        [[x + speed * np.cos(heading) * seconds, y + speed * np.sin(heading) * seconds, heading]]
    )


@given(POSE, POSE)
def test_outlines_touch_at_the_time_to_collision_and_never_before(ego: Pose, other: Pose) -> None:
    sizes = np.array([CAR]), np.array([TRUCK])
    time_s = ttc_s(ego, other, (CAR, TRUCK))

    def apart_m(seconds: float) -> float:
        return float(
            separation_m(moved(ego, seconds), sizes[0], moved(other, seconds), sizes[1])[0]
        )

    for seconds in np.linspace(0.0, min(time_s, 20.0), 50)[:-1]:
        assert time_s == 0.0 or apart_m(seconds) > -1e-6
    if 0.0 < time_s < 20.0:
        assert apart_m(time_s) == pytest.approx(0.0, abs=1e-6)
    if time_s == 0.0:
        assert apart_m(0.0) <= 1e-6


@given(POSE, POSE, st.floats(-3.2, 3.2), st.floats(-50, 50))
# Headings that differ by nothing but the smallest of numbers, which a turn rounds off.
@example((0.0, 0.0, -2.6505507264452935e-207, 1.0), (0.0, -3.0, 0.0, 1.0), 1.0, 0.0)
def test_neither_order_nor_frame_of_reference_changes_it(
    ego: Pose, other: Pose, turn: float, shift_m: float
) -> None:
    def seen(pose: Pose) -> Pose:
        x, y, heading, speed = pose
        cos, sin = np.cos(turn), np.sin(turn)
        return x * cos - y * sin + shift_m, x * sin + y * cos - shift_m, heading + turn, speed

    def within(a: Pose, b: Pose, margin_m: float) -> float:
        grown = tuple((length + margin_m, width + margin_m) for length, width in (CAR, TRUCK))
        return min(ttc_s(a, b, grown), LONG_S)

    exact = min(ttc_s(ego, other, (CAR, TRUCK)), LONG_S)
    assert min(ttc_s(other, ego, (TRUCK, CAR)), LONG_S) == pytest.approx(exact, abs=1e-6, rel=1e-6)
    # Rounding may turn a graze into a miss, so both may be by a hair.
    assert within(seen(ego), seen(other), 1e-6) <= exact + 1e-6
    assert within(seen(ego), seen(other), -1e-6) >= exact - 1e-6


def test_a_crossing_is_as_long_free_as_the_frames_between_say() -> None:
    """The ego's tail leaves the other's strip after 1.35 s;
    the other reaches the ego's after 3.35 s.
    """
    ego, other = straight((10.0, 0.0, 0.0, 10.0), 50), straight((20.0, 37.0, NORTH, 10.0), 50)
    for first_ego in (True, False):
        poses = driven(*((ego, other) if first_ego else (other, ego)))
        conflicts = measured(poses)
        assert conflicts.pet_s == pytest.approx(2.0, abs=2 / HZ)
        assert conflicts.ttc_s == np.inf
    before = measured(driven(ego, other)[:, :34])  # the last frame in which it has not arrived
    assert (before.pet_s, before.anew().pet_s) == (np.inf, np.inf)


def test_vehicles_side_by_side_have_no_conflict_and_one_behind_the_other_have_a_gap_in_time() -> (
    None
):
    ego = straight((0.0, 0.0, 0.0, 10.0), 40)
    assert measured(driven(ego, straight((3.0, 3.5, 0.0, 12.0), 40))).pet_s == np.inf
    following = measured(driven(ego, straight((25.0, 0.0, 0.0, 10.0), 40)))
    assert following.pet_s == pytest.approx(20.0 / 10.0, abs=2 / HZ)
    assert following.ttc_s == np.inf


def test_what_comes_after_the_horizon_is_no_conflict() -> None:
    ego = straight((0.0, 0.0, 0.0, 10.0), 90)
    for start_m, missing in ((76.0, False), (78.0, True)):  # the ego leaves after 2.35 s
        conflicts = measured(driven(ego, straight((20.0, start_m, NORTH, 10.0), 90)), parts=7)
        assert (conflicts.pet_s == np.inf) == missing
        assert missing or conflicts.pet_s == pytest.approx(HORIZON_S - 0.1, abs=2 / HZ)
    slow = straight((48.0, 0.0, 0.0, 1.0), 1), straight((50.0 + 43.0 + 5.0, 0.0, 0.0, 1.0), 1)
    assert measured(driven(straight((0.0, 0.0, 0.0, 10.0), 1), slow[0])).ttc_s == pytest.approx(
        43.0 / 9.0
    )
    assert measured(driven(straight((0.0, 0.0, 0.0, 10.0), 1), slow[1])).ttc_s == np.inf


@pytest.mark.parametrize("hz", [10, 15, 19, 23, 28, 31, 34, 35, 50, 60])
def test_no_rate_of_frames_sees_beyond_the_horizon(hz: int) -> None:
    """At 15 Hz moments are 133 ms apart, and 38 of them are more than five seconds."""
    every = max(1, round(hz / MOMENTS_HZ))
    stands = np.array([(0.0, 0.0, 0.0, 0.0)])
    gone = np.array([(1000.0, 0.0, 0.0, 0.0)])
    for away in range(round(4.5 * hz), round(5.5 * hz)):
        ego = np.concatenate([np.repeat(stands, hz, axis=0), np.repeat(gone, away, axis=0)])
        other = np.concatenate(
            [np.repeat(-gone, len(ego) - every, axis=0), np.repeat(stands, every, axis=0)]
        )
        pet_s = measured(driven(ego, other), hz=hz).pet_s
        assert pet_s == np.inf or pet_s <= HORIZON_S
        assert pet_s < np.inf or away > hz * HORIZON_S - 2 * every


def wandering(seed: int, vehicles: int, frames: int, hz: int = HZ) -> Floats:
    """Vehicles that brake, turn and drive on within a few lengths of each other."""
    rng = np.random.default_rng(seed)
    tracks = []
    for _ in range(vehicles):
        speed = np.abs(np.cumsum(rng.normal(0, 0.5, frames)) + rng.uniform(0, 12))
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.05, frames))
        steps = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1) / hz
        tracks.append(
            np.column_stack([rng.uniform(-20, 20, 2) + np.cumsum(steps, axis=0), heading, speed])
        )
    return driven(*tracks)


def searched(poses: Floats, sizes: Floats, hz: int) -> tuple[float, float]:
    """Both measures from all pairs of frames, each tenth of a second."""
    poses = poses[:, hz // 10 - 1 :: hz // 10]
    frames, ttc, pet = poses.shape[1], np.inf, np.inf
    early, late = np.triu_indices(frames)
    for other in range(1, poses.shape[2]):
        pair = poses[0][:, [0, other]], sizes[[0, other]]
        each = [np.repeat(size[None], frames, axis=0) for size in pair[1]]
        ttc = min(ttc, times_to_collision(pair[0][:, 0], each[0], pair[0][:, 1], each[1]).min())
        for first in (0, 1):
            then = [np.repeat(pair[1][k][None], len(early), axis=0) for k in (first, 1 - first)]
            at = pair[0][early, first, :3], pair[0][late, 1 - first, :3]
            touch = separation_m(at[0], then[0], at[1], then[1]) <= 0
            pet = min(pet, (late - early)[touch].min(initial=10**6) * 0.1)
    return ttc if ttc <= HORIZON_S else np.inf, pet if pet <= HORIZON_S else np.inf


@settings(max_examples=15 if QUICK else 100)
@given(
    st.integers(0, 10**6), st.integers(2, 4), st.integers(1, 60), st.integers(1, 9), st.sampled_from((10, 50))
)  # fmt: skip
def test_a_search_through_all_moments_finds_the_same(
    seed: int, vehicles: int, moments: int, parts: int, hz: int
) -> None:
    frames = moments * hz // 10
    poses = wandering(seed, vehicles, frames, hz)
    sizes = tuple((CAR, TRUCK)[n % 2] for n in range(vehicles))
    conflicts = measured(poses, sizes, min(parts, frames), hz)
    assert (conflicts.ttc_s, conflicts.pet_s) == searched(poses, np.array(sizes), hz)


def test_worlds_with_other_numbers_of_frames_and_vehicles_are_measured_as_alone() -> None:
    shapes = {6: (4, 60), 59: (2, 25), 11: (3, 60), 0: (4, 1), 12: (4, 40), 45: (2, 60)}
    worlds = [wandering(seed, *shape) for seed, shape in shapes.items()]
    sizes = np.ones((len(worlds), 4, 2))
    sizes[:] = CAR
    together = np.full((len(worlds), 60, 4, 4), np.nan)
    for n, poses in enumerate(worlds):
        together[n, : poses.shape[1], : poses.shape[2]] = poses[0]
    found = observe(
        [Conflicts()] * len(worlds), together, sizes, np.ones(len(worlds), dtype=int), HZ
    )
    alone = [measured(poses, (CAR,) * poses.shape[2]) for poses in worlds]
    assert [(each.ttc_s, each.pet_s) for each in found] == [
        (each.ttc_s, each.pet_s) for each in alone
    ]
    assert len({each.pet_s for each in alone}) > 4


def test_who_leaves_is_forgotten_and_who_enters_has_been_nowhere() -> None:
    ego, other = straight((10.0, 0.0, 0.0, 10.0), 50), straight((20.0, 37.0, NORTH, 10.0), 50)
    [begun] = observe(
        [Conflicts()], driven(ego, other)[:, :30], np.array([(CAR, CAR)]), np.array([1]), HZ
    )
    far = straight((10.0, 90.0, 0.0, 10.0), 50)
    later, sizes = driven(ego, far, other)[:, 30:], np.array([(CAR, CAR, CAR)])
    [kept] = observe([begun.recast([0, -1, 1])], later, sizes, np.array([31]), HZ)
    assert kept.pet_s == measured(driven(ego, other)).pet_s
    [other_first] = observe(
        [begun.recast([1, -1, 0])], later[:, :, [2, 1, 0]], sizes, np.array([31]), HZ
    )
    assert other_first.pet_s == kept.pet_s


def test_a_collision_has_no_time_left() -> None:
    world = World.start(SCENARIO, 1)  # a danger from the right
    while not world.outcome.ended:
        world.act("IDLE")
    assert world.outcome.result == "collision"
    assert (world.journey.conflicts.ttc_s, world.journey.conflicts.pet_s) == (0.0, 0.0)


def test_columns_tell_what_was_not_near_from_what_was_not_measured() -> None:
    made = columns(np.array([np.inf, np.nan, 1.4996, 1.4994]), np.array([np.inf, np.nan, 0.0, 5.0]))
    np.testing.assert_equal(made["ttc_s"], [np.nan, np.nan, 1.5, 1.499])
    np.testing.assert_equal(made["short_ttc"], [0, np.nan, 0, 1])
    np.testing.assert_equal(made["pet_s"], [np.nan, np.nan, 0.0, 5.0])
    np.testing.assert_equal(made["short_pet"], [0, np.nan, 1, 0])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in FEW else pytest.mark.exhaustive)
        for name in scenarios.names()
    ],
)
def test_a_scenarios_worlds_are_measured_as_a_search_finds(name: str) -> None:
    """Real roads, in lockstep: curves, lane changes and standing vehicles."""
    scenario = scenarios.get(name)
    worlds = [World.start(scenario, 2000 + n) for n in range(4)]
    frames: list[list[Floats]] = [[] for _ in worlds]
    passed = World.passed

    def recorded(world: World, poses: Floats) -> None:
        frames[worlds.index(world)].append(poses)
        passed(world, poses)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(World, "passed", recorded)
        for until in (20, 45, 100, 170, 240, 300):
            for n, world in enumerate(worlds):
                if not world.outcome.ended:
                    world.take(scenario.actions[(n + until) % len(scenario.actions)])
            lockstep.advance(worlds, [until] * len(worlds))
    for world, parts in zip(worlds, frames, strict=True):
        if world.outcome.result != "collision":
            sizes = np.array([(v.LENGTH, v.WIDTH) for v in world.vehicles])
            found = world.journey.conflicts.ttc_s, world.journey.conflicts.pet_s
            assert found == searched(np.concatenate(parts)[None], sizes, 50)
