"""The decision points that a model learns from, and what it should have intended there.

They are drawn from the decision trees of train layouts, up to `PER_LEVEL` points of each level. So
a model sees the scenes that its own errors lead to. An episode passes one point of each level, so
the levels of a layout weigh alike: the point at which every episode begins as much as all points of
a later level together.

An action is safe if the episode still succeeds when the driver that sees no more than the ego takes
the rest: what only one who sees everything could still save is not safe for who does not. Each safe
action has the weight exp(-delay / 0.25 s), so that a needless SLOWER counts little; an unsafe one
has none. Where IDLE and another come to the same (FASTER at the highest speed level, a lane as
good) most goes to IDLE. A viewer that cannot tell scenes apart is best served by the mean of their
labels, so what it cannot see makes it unsure. A point at which nothing is safe any more teaches
nothing; what follows it may, where that driver is too bold to take the rest and one more SLOWER
saves it.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import msgspec
import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
from harness.core.files import bytes_of, write_whole
from harness.core.parallel import Workers, each
from harness.core.work import kept_file
from harness.dataset.freeze import edges, record_of
from harness.dataset.load import Scene
from harness.dataset.schema import Record, scene_id
from harness.prompts.versions import Prompt
from harness.world.drivers import PRIVILEGED
from harness.world.outcome import Outcome
from harness.world.reference import drive, finish
from harness.world.scenario import Scenario
from harness.world.world import World

TEACHER = "local-view"
SOFTNESS_S = 0.25
PER_LEVEL = 6  # decision points of a level that are learnt from
MOST_TRIED = 40  # decision points of a level that are tried to find them
# Weight of an action beside equals, 1 if not named.
PRIOR = {"FASTER": 0.3, "LANE_LEFT": 0.3, "LANE_RIGHT": 0.3}


class Point(msgspec.Struct, frozen=True):
    """Hold one decision point to learn from: a scene, and what a model should answer there.

    `record` is the scene, with what every vehicle sees. `label` (A,) is a soft label: the
    probabilities that the model should give to the scenario's A actions.
    """

    record: Record  # the scene: its state, and every viewer's scene graph
    label: list[float]  # soft label, (A,): probabilities of the scenario's A meta-actions


@dataclass(frozen=True)
class Lessons:
    """Hold the scenes of one scenario that a model learns from, and what it should answer there.

    Scenes are decision points of layouts, drawn start situations of the scenario. `labels` has the
    soft label of each by its id, (A,): the probabilities that the model should give to A actions.
    `prompts` are the versions that ask. `balanced` says that layouts with a danger (a vehicle that
    the ego would meet) and those without weigh alike.
    """

    scenario: Scenario  # whose actions and words the prompts have
    prompts: tuple[Prompt, ...]  # versions that are learnt
    scenes: tuple[Scene, ...]  # decision points, layout by layout
    # soft label of each, (A,), by its id: the probabilities that the model should give to the
    # scenario's A actions
    labels: Mapping[str, Floats]
    # whether layouts with a danger and those without weigh alike, as in balanced success
    balanced: bool = False

    @property
    def episodes(self) -> tuple[int, ...]:
        """Return the numbers of the layouts (start situations) of the scenes, each once."""
        return tuple(dict.fromkeys(scene.record.episode for scene in self.scenes))

    @cached_property
    def weights(self) -> Mapping[str, float]:
        """Return the training weight of each scene, by scene id.

        All scenes of one step of one layout (start situation) share a weight of 1. If `balanced`,
        layouts with a danger (a vehicle that the ego would meet) and those without have the same
        total.
        """
        levels = [(scene.record.episode, scene.record.step) for scene in self.scenes]
        points = Counter(levels)
        weights = np.array([1 / points[level] for level in levels])
        dangerous = np.array([scene.record.danger.sector is not None for scene in self.scenes])
        if self.balanced and 0 < dangerous.sum() < len(dangerous):
            for half in (dangerous, ~dangerous):
                weights[half] /= weights[half].sum()
            weights *= len(weights)
        return dict(zip((scene.id for scene in self.scenes), weights.tolist(), strict=True))

    def split(self, held_out: float) -> "tuple[Lessons, Lessons]":
        """Return these lessons in two: the first layouts, to learn, and the last, to test.

        A layout is a start situation. `held_out` is the share of layouts that the second part gets,
        0 to 1, at least one layout.
        """
        last = self.episodes[-max(1, round(len(self.episodes) * held_out)) :]
        kept = tuple(scene for scene in self.scenes if scene.record.episode not in last)
        held = tuple(scene for scene in self.scenes if scene.record.episode in last)
        return replace(self, scenes=kept), replace(self, scenes=held)


def draw(
    scenario: Scenario,
    prompts: Sequence[Prompt],
    layouts: int,
    seed: int,
    place: Path,
    workers: Workers,
    progress: Callable[[int], None],
) -> Lessons:
    """Draw the situations in which a model learns to decide, with the right answers, as lessons.

    They are of `layouts` start situations (layouts) of the scenario. Each layout is a file in the
    folder `place`, and only missing ones are drawn, so that a killed call resumes. Layout number n
    has layout seed `seed + n`; `progress` is called with the number of layouts just done.
    """
    place.mkdir(parents=True, exist_ok=True)
    files = [place / f"{n:05d}.json" for n in range(layouts)]
    todo = [n for n, file in enumerate(files) if not file.is_file()]
    progress(layouts - len(todo))

    def keep(at: int, data: bytes) -> None:
        write_whole(files[todo[at]], data)
        progress(1)

    each(partial(_encoded, scenario, seed), todo, workers, keep, lambda number: f"layout {number}")
    decoder = msgspec.json.Decoder(list[Point])
    points = list[Point]()
    for file in files:
        with kept_file(file):
            points += decoder.decode(bytes_of(file, "record"))
    scenes = tuple(Scene.of(point.record, scenario) for point in points)
    labels = {point.record.scene: np.array(point.label) for point in points}
    return Lessons(scenario, tuple(prompts), scenes, labels)


def _encoded(scenario: Scenario, seed: int, number: int) -> bytes:
    return msgspec.json.encode(decision_points(scenario, seed + number, number))


def decision_points(scenario: Scenario, seed: int, number: int) -> list[Point]:
    """Draw decision points of one layout to learn from, up to six for each step of its tree.

    A layout is a start situation, and its tree every course that actions can lead to. `seed` is the
    layout seed, and `number` the episode number that the records get. A point after which no action
    leads to success is left out.
    """
    rng = noise.generator("lessons", scenario.name, seed)
    reference, points = drive(scenario, PRIVILEGED, seed), []
    level = [World.start(scenario, seed)]
    while level:
        following: dict[str, World] = {}
        taken, left = 0, rng.permutation(len(level))[:MOST_TRIED].tolist()
        while left and taken < PER_LEVEL:
            tried, left = left[: PER_LEVEL - taken], left[PER_LEVEL - taken :]
            branches, led = edges([level[n] for n in tried], [number] * len(tried))
            children = [child for _, child in led]
            outcomes = finish([child.branch() for child in children], [TEACHER] * len(children))
            for n, out in zip(tried, branches, strict=True):
                world, state = level[n], level[n].state()
                ends_s = dict.fromkeys(world.actions, float(np.inf))
                for edge in out:
                    end = edge.end
                    outcome = Outcome(end.result, end.time_s) if end else outcomes[edge.to or 0]
                    judged = outcome.judged(reference, world.layout.danger, scenario.parameters)
                    if judged.success and outcome.time_s is not None:
                        ends_s.update(dict.fromkeys(edge.actions, outcome.time_s))
                if np.isfinite(list(ends_s.values())).any():
                    taken += 1
                    record = record_of(world, state, number, (state.ego, *state.helpers))
                    points.append(Point(record, label(ends_s).tolist()))
            following.update({scene_id(number, child.state()): child for child in children})
        level = list(following.values())
    return points


def label(ends_s: Mapping[str, float]) -> Floats:
    """Return the soft label (A,) of a decision point: probabilities of its A actions.

    A decision point is a situation in which the ego must act. `ends_s` has, by action, the time in
    seconds at which the episode succeeds after it, inf for never; at least one has to be finite. A
    probability falls with the delay by exp(-delay / 0.25 s).
    """
    time_s = np.array(list(ends_s.values()))
    weight = np.array([PRIOR.get(a, 1.0) for a in ends_s]) * np.exp(
        (time_s.min() - time_s) / SOFTNESS_S
    )
    return np.asarray(weight / weight.sum())
