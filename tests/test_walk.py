"""The walk through frozen scenes, step by step, against results that can be counted by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from evaluating import (
    A_TENTH,
    Scripted,
    Walked,
    all_scenes,
    asker_of,
    course,
    says,
    spec_of,
    sure,
    walked,
)

from harness.coordination.consensus import Fused, linear_pool
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import RULES
from harness.dataset.load import Dataset
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.walk import walk

OUTCOMES = {
    f"0000{episode}-{step}": {"FASTER": "collision"}
    for episode, steps in ((0, 3), (1, 2), (2, 3)) for step in range(steps)
}  # fmt: skip
EGO = says([0.5, 0.3, 0.2])  # 1.03 nats: it asks at every step
POOLED = OperatingPoint.of("pooled", "6g", loss=0.0)


@dataclass(frozen=True)
class Smooth:
    """The mean of what it would do now and of what it did at the last step."""

    def start(self, batch, helpers, actions):
        return np.full((*batch, actions), np.nan)

    def fuse(self, messages, state):
        now = linear_pool(messages.intents, messages.weights)
        policy = np.where(np.isnan(state), now, (now + state) / 2)
        return Fused(policy, messages.weights, policy)


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RULES._loaded, "smooth", Smooth())


@pytest.fixture
def halves() -> OperatingPoint:
    return POOLED.changed(name="halves", consensus="smooth")


@pytest.fixture
def lossy() -> OperatingPoint:
    return POOLED.changed(name="lossy", consensus="smooth", loss=0.3)


@pytest.fixture
def played(small: Dataset) -> Dataset:
    """Episode 1 ends a step before its neighbours.
    Every vehicle is as far from the zone as any other.
    """
    data = course(small, 3, OUTCOMES)
    scenes = [
        scene.changed(distance_m=dict.fromkeys(scene.record.distance_m, 10.0))
        for scene in all_scenes(data)
    ]
    return replace(data, _scenes={scene.id: scene for scene in scenes})


def script(data: Dataset) -> Scripted:
    """Helpers are sure of SLOWER at the first step,
    of IDLE at the second and of FASTER at the third.
    """
    lines = {}
    for scene in all_scenes(data):
        action = data.actions[scene.record.step]
        lines |= {f"{scene.id}/{viewer}": sure(action, "helper") for viewer in scene.viewers[1:]}
        lines[f"{scene.id}/{scene.viewers[0]}"] = EGO
    return Scripted(lines)


def fused(told: Walked, point: OperatingPoint, episode: int, seed: int = 0) -> list[list[float]]:
    scenes = sorted({scene.id for part in told.parts for scene in part.decision_points})
    policies = dict(zip(scenes, told.result(point, "fused", seed), strict=True))
    return [policies[scene].tolist() for scene in scenes if scene.startswith(f"{episode:05d}-")]


def test_a_rule_with_memory_carries_its_state_from_step_to_step(
    played: Dataset, halves: OperatingPoint
) -> None:
    """Four equal weights: the pool is (.875, .075, .05), (.125, .825, .05),
    (.125, .075, .8) at three steps.

    Half of each and half of what was before: (.875, .075, .05), (.5, .45, .05), (.3125, .2625,
    .425). So the first two steps brake and the third, whose memory is not enough, goes faster into
    a collision.
    """
    told = walked(spec_of(played, points=(halves, POOLED), seeds=(0, 1)), script(played))
    expected = [[0.875, 0.075, 0.05], [0.5, 0.45, 0.05], [0.3125, 0.2625, 0.425]]
    for seed in (0, 1):
        for episode, steps in ((0, 3), (1, 2), (2, 3)):
            assert fused(told, halves, episode, seed) == [
                pytest.approx(p) for p in expected[:steps]
            ]
        pool = [[0.875, 0.075, 0.05], [0.125, 0.825, 0.05], [0.125, 0.075, 0.8]]
        assert fused(told, POOLED, 0, seed) == [pytest.approx(p) for p in pool]
    assert [d.action for d in told.records("halves") if d.episode == 0 and d.seed == 0] == [
        "SLOWER", "SLOWER", "FASTER"
    ]  # fmt: skip
    ends = {(e.episode, e.seed): e.failure for e in told.episodes if e.condition == "halves"}
    assert ends == {(n, s): "" if n == 1 else "collision" for n in (0, 1, 2) for s in (0, 1)}


def test_memory_goes_with_the_episode_and_the_seed(
    played: Dataset, halves: OperatingPoint, lossy: OperatingPoint
) -> None:
    """Links that are up or down by seed give each seed a course of its own;
    alone it is the same.
    """
    seeds = (0, 1, 2, 3, 4)
    together = walked(spec_of(played, points=(halves, lossy), seeds=seeds), script(played))
    courses = set()
    for seed in seeds:
        alone = walked(spec_of(played, points=(lossy,), seeds=(seed,)), script(played))
        for episode in (0, 1, 2):
            course = fused(together, lossy, episode, seed)
            assert course == fused(alone, lossy, episode, seed)
            courses.add(str(course))
            heard = [
                sum(m.on_time for m in d.messages)
                for d in together.records("lossy") if (d.episode, d.seed) == (episode, seed)
            ]  # fmt: skip
            assert course == [pytest.approx(p) for p in by_hand(heard)]
    assert len(courses) > 3, "courses that are all alike would not show the memory"


def test_shuffled_messages_are_those_of_the_next_layout_that_decides(played: Dataset) -> None:
    """Helpers of episode e are sure of action e,
    so an episode that goes FASTER into a collision is over.

    First 0 hears IDLE of 1, 1 hears FASTER of 2 and 2 SLOWER of 0; then 2 and 0 are left, and hear
    each other: 0 collides. Whoever is alone keeps its own (.5, .3, .2).
    """
    lines = {f"{scene.id}/{scene.viewers[0]}": EGO for scene in all_scenes(played)}
    for scene in all_scenes(played):
        intent = sure(played.actions[scene.record.episode], "helper")
        lines |= {f"{scene.id}/{viewer}": intent for viewer in scene.viewers[1:]}
    control = POOLED.changed(name="control", messages="shuffled")
    told = walked(spec_of(played, points=(control,), seeds=(0, 1)), Scripted(lines))
    braking, keeping, faster = (tuple(p) for p in np.array([0.125, 0.075, 0.05]) + 0.75 * np.eye(3))
    expected = {
        (0, 0): keeping, (0, 1): faster, (0, 2): braking,
        (1, 0): faster, (1, 2): braking,
        (2, 2): (0.5, 0.3, 0.2),
    }  # fmt: skip
    for seed in (0, 1):
        fused = {(d.step, d.episode): d.fused for d in told.records("control") if d.seed == seed}
        assert fused == {place: pytest.approx(policy) for place, policy in expected.items()}


def by_hand(heard: list[int]) -> list[np.ndarray]:
    """The policies where so many helpers are heard at each step;
    an ego that hears nobody keeps its own.
    """
    own, memory, policies = np.array([0.5, 0.3, 0.2]), None, []
    for step, n in enumerate(heard):
        pool = (own + n * np.eye(3)[step]) / (1 + n)
        memory = pool if memory is None else (pool + memory) / 2
        policies.append(memory if n else own)
    return policies


def test_every_step_is_asked_once_and_yields_a_part_a_condition(
    played: Dataset, halves: OperatingPoint, lossy: OperatingPoint
) -> None:
    backend = script(played)
    spec = spec_of(played, points=(halves, lossy), seeds=(0, 1))
    asker = asker_of(spec, backend, A_TENTH)
    assert len(backend.asked) == len(set(backend.asked)) == 8 * 4
    world = FrozenWorld(played, spec.points, spec.seeds)
    steps = list(walk(world, spec.points, asker, spec.ties))
    assert [[part.point.name for part in parts] for parts in steps] == [["halves", "lossy"]] * 3
    assert [len(parts[0].decision_points) for parts in steps] == [3, 3, 2]
    assert [parts[0].due.episode.tolist() for parts in steps] == [
        [0, 1, 2, 0, 1, 2], [0, 1, 2, 0, 1, 2], [0, 2, 0, 2]
    ]  # fmt: skip
    assert len(backend.asked) == 8 * 4, "what is asked already is not asked again"
