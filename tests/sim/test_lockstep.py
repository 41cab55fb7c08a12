"""Worlds that are simulated together are, to the last bit, what each becomes alone,
and under highway-env.
"""

from dataclasses import replace

import numpy as np
import one_way_crossing
import pytest
from frames import highway_envs_frame, poses
from tiers import some

from harness.world import lockstep, scenarios
from harness.world.world import World

EVERY = [*map(scenarios.get, scenarios.names()), one_way_crossing.SCENARIO]


def everything(world):
    """All of a world that the next frame depends on, and all that is reported of it."""
    return (
        world.frame,
        world.step,
        world.outcome,
        world.journey.hard_brakings,
        world.journey.braking_hard,
        (world.journey.conflicts.ttc_s, world.journey.conflicts.pet_s),
        world.beacons,
        poses(world),
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("scenario", EVERY, ids=lambda s: s.name)
def test_together_is_as_alone(scenario):
    drive_apart_and_together(scenario, worlds=14)


@pytest.mark.parametrize("name", some(["roundabout-entries"], exhaustive=["occluded-intersection"]))
def test_a_few_together_are_as_alone(name):
    """Straight lanes and a circle, and traffic that comes to a stop."""
    drive_apart_and_together(scenarios.get(name), worlds=3)


@pytest.mark.parametrize("kind", ["bicycle", "motorcycle", "pedestrian"])
def test_narrow_traffic_moves_together_as_alone(kind):
    crossing = one_way_crossing.SCENARIO

    def layout(seed, parameters):
        drawn = crossing.layout(seed, parameters)
        spawns = [replace(s, kind=kind) if s.part == "other" else s for s in drawn.spawns]
        return replace(drawn, spawns=tuple(spawns))

    drive_apart_and_together(replace(crossing, layout=layout), worlds=4)


def drive_apart_and_together(scenario, worlds):
    """Whatever each decides, and whenever:
    none is in step with another, and they end one by one.
    """
    rng = np.random.default_rng(7)
    alone = [World.start(scenario, 2000 + n // 2) for n in range(worlds)]
    together, plain = ([world.branch() for world in alone] for _ in range(2))
    p, ends = scenario.parameters, set()
    while not all(world.outcome.ended for world in alone):
        until = [world.frame + int(rng.integers(1, 90)) for world in alone]
        for same in zip(alone, together, plain, strict=True):
            action = str(rng.choice(scenario.actions))
            for world in same:
                if not world.outcome.ended:
                    world.take(action)
        for world, theirs, frame in zip(alone, plain, until, strict=True):
            world.advance(frame)
            while theirs.frame < frame and not theirs.outcome.ended:
                highway_envs_frame(theirs)
        lockstep.advance(together, until)
        assert [poses(world) for world in plain] == [poses(world) for world in alone]
        assert [world.outcome.result for world in plain] == [
            world.outcome.result for world in alone
        ]
        assert [everything(world) for world in together] == [everything(world) for world in alone]
    ends = {world.outcome.result for world in alone}
    assert len(ends) > 1, "no episode ended otherwise than the rest"
    assert all(world.frame <= p.time_limit_s * p.simulation_hz for world in together)


def test_wrecks_stay_where_they_are_and_their_worlds_go_on():
    """Two others that run into each other: everything that highway-env does with wrecks is done."""
    scenario = scenarios.get("occluded-intersection")
    seed = next(
        seed for seed in range(2000, 2200)
        if len({s.approach for s in scenario.layout(seed, scenario.parameters).spawns[1:]}) > 1
    )  # fmt: skip
    worlds = []
    for shift_m in np.linspace(-6.0, 6.0, 7):
        world = World.start(scenario, seed)
        one, other = world.vehicles[1:3]
        other.position = one.position + np.array([shift_m, 0.5])
        worlds.append(world)
    alone = [world.branch() for world in worlds]
    lockstep.advance(worlds, [40] * len(worlds))
    for world in alone:
        world.advance(40)
    assert [everything(world) for world in worlds] == [everything(world) for world in alone]
    assert {world.outcome.other_crashes > 0 for world in worlds} == {True, False}


@pytest.mark.exhaustive
def test_environments_are_simulated_by_highway_env():
    scenario = scenarios.get("env:highway-v0")
    worlds = [World.start(scenario, seed) for seed in range(2)]
    alone = [world.branch() for world in worlds]
    lockstep.advance(worlds, [3, 16])
    for world, frame in zip(alone, (3, 16), strict=True):
        world.advance(frame)
    assert [world.state() for world in worlds] == [world.state() for world in alone]
