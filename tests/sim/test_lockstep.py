"""Worlds that are simulated together are, to the last bit, what each becomes alone."""

import sys
from collections import Counter
from importlib.util import find_spec

import numpy as np
import one_way_crossing
import pytest

from harness.world import lockstep, scenarios
from harness.world.world import World

WORLDS = 14
EVERY = [*map(scenarios.get, scenarios.names()), one_way_crossing.SCENARIO]
COMPILED = pytest.param(
    0, id="compiled", marks=pytest.mark.skipif(not find_spec("numba"), reason="needs the fast extra")
)


@pytest.fixture(params=[pytest.param(10**9, id="numpy"), COMPILED])
def form(request, monkeypatch):
    """One of the two forms, which must have simulated all frames in the end."""
    monkeypatch.setattr(lockstep, "COMPILED_AFTER", request.param)
    monkeypatch.setattr(lockstep, "_frames", Counter())
    yield
    [used] = lockstep._frames
    assert used is (lockstep.Fleet if request.param else lockstep.compiled_fleet())


def everything(world):
    """All of a world that the next frame depends on, and all that is reported of it."""
    vehicles = [
        (
            *v.position.tolist(), v.heading, v.speed, v.target_speed, v.crashed, v.braking, v.lane_index,
            v.target_lane_index, v.route, v.spawn, None if v.impact is None else v.impact.tolist(),
        )
        for v in world.vehicles
    ]  # fmt: skip
    return (
        world.frame,
        world.step,
        world.outcome,
        world.hard_brakings,
        world.braking_hard,
        (world.conflicts.ttc_s, world.conflicts.pet_s),
        world.beacons,
        vehicles,
    )


@pytest.mark.slow
@pytest.mark.parametrize("scenario", EVERY, ids=lambda s: s.name)
def test_together_is_as_alone(scenario, form):
    """Whatever each decides, and whenever: none is in step with another, and they end one by one."""
    rng = np.random.default_rng(7)
    alone = [World.start(scenario, 2000 + n // 2) for n in range(WORLDS)]
    together = [world.branch() for world in alone]
    p, ends = scenario.parameters, set()
    while not all(world.outcome.ended for world in alone):
        until = [world.frame + int(rng.integers(1, 90)) for world in alone]
        for one, other in zip(alone, together, strict=True):
            if not one.outcome.ended:
                action = str(rng.choice(scenario.actions))
                one.take(action)
                other.take(action)
        for world, frame in zip(alone, until, strict=True):
            world.advance(frame)
        lockstep.advance(together, until)
        assert [everything(world) for world in together] == [everything(world) for world in alone]
    ends = {world.outcome.result for world in alone}
    assert len(ends) > 1, "no episode ended otherwise than the rest"
    assert all(world.frame <= p.time_limit_s * p.simulation_hz for world in together)


def test_wrecks_stay_where_they_are_and_their_worlds_go_on(form):
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


@pytest.mark.slow
def test_environments_are_simulated_by_highway_env():
    scenario = scenarios.get("env:highway-v0")
    worlds = [World.start(scenario, seed) for seed in range(3)]
    alone = [world.branch() for world in worlds]
    lockstep.advance(worlds, [5, 7, 60])
    for world, frame in zip(alone, (5, 7, 60), strict=True):
        world.advance(frame)
    assert [world.state() for world in worlds] == [world.state() for world in alone]


def simulated(frames):
    """Simulate frames of some worlds; the names of the classes that did."""
    lockstep._frames.clear()
    worlds = [World.start(scenarios.get("occluded-intersection"), 2000 + n) for n in range(WORLDS)]
    for frame in range(10, frames + 1, 10):
        lockstep.advance(worlds, [frame] * WORLDS)
    return {form.__name__: count for form, count in lockstep._frames.items()}


@pytest.fixture
def anew():
    """Nothing is known of numba, before and after."""
    lockstep.compiled_fleet.cache_clear()
    yield
    lockstep.compiled_fleet.cache_clear()


def test_numba_is_loaded_after_some_frames(monkeypatch, anew):
    pytest.importorskip("numba", reason="needs the fast extra")
    monkeypatch.setattr(lockstep, "COMPILED_AFTER", 20)
    assert simulated(50) == {"Fleet": 20, "CompiledFleet": 30}


def test_without_numba_frames_are_numpys_and_nothing_is_said(monkeypatch, anew, capsys):
    monkeypatch.setattr(lockstep, "COMPILED_AFTER", 0)
    monkeypatch.setitem(sys.modules, "numba", None)
    assert simulated(20) == {"Fleet": 20}
    assert capsys.readouterr().err == ""


def test_a_numba_that_does_not_work_is_named_once(monkeypatch, anew, capsys, tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('Numba needs NumPy 2.2 or less. Got NumPy 9.9.')")
    monkeypatch.setattr(lockstep, "COMPILED_AFTER", 0)
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.delitem(sys.modules, "harness.world.compiled", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert simulated(30) == {"Fleet": 30}
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("harness: ")
    assert "Got NumPy 9.9." in line
