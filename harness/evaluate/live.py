"""Drives many episodes in step: at each decision's time one batch of questions, then the time until the next.

Decision k is due at k decision periods. Whoever is asked answers from what it sees in that frame; the action
is taken in the first frame that begins after the decision's latency, and until then the ego keeps to its last
action. A decision that is still open when the next is due goes on, and the next one is skipped.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from harness.backends.base import Backend
from harness.coordination.coordinate import coordinate
from harness.coordination.exchange import Luck, exchange
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise as luck
from harness.core.arrays import Floats, Ints
from harness.core.files import digest
from harness.dataset.freeze import moment
from harness.dataset.load import Scene
from harness.evaluate import merging
from harness.evaluate.asking import answer_of, requests
from harness.evaluate.branches import Decision, Episode, Trajectory
from harness.evaluate.intents import Intents, intents
from harness.evaluate.live_spec import Drive
from harness.evaluate.merging import Merged
from harness.evaluate.timing import inference_s, merge_s
from harness.runs import driven_record as record
from harness.world import reference as live
from harness.world import scenarios
from harness.world.drivers import PRIVILEGED
from harness.world.world import World

SCENARIO = scenarios.get(scenarios.DEFAULT)
P = SCENARIO.parameters
ROUNDING_FRAMES = 1e-6  # a latency of 0.14 s is 7 frames and not 7.000000000000001


def drive(
    spec: Drive, backend: Backend, latency: Mapping[str, Any], episodes: Sequence[int]
) -> tuple[list[record.Row], list[record.Row]]:
    """Drive some episodes of a run under all of its conditions and seeds.

    Args:
        spec: the run.
        backend: who answers.
        latency: where a decision's time comes from, as in a run's manifest.
        episodes: numbers of the episodes.

    Returns:
        A row a moment that somebody decided in, and a row an episode, condition and seed; neither depends on
        which other episodes are driven with them.
    """
    going = [start(spec, number) for number in episodes]
    arrived, moments = [], []
    for step in range(P.decisions):
        moments += _decide(spec, backend, latency, going, step)
        last = step + 1 == P.decisions
        until_s = P.time_limit_s if last else (step + 1) * P.decision_period_s
        parts = [part for one in going for part in one.advance(round(until_s * P.simulation_hz))]
        arrived += [one for one in parts if one.world.outcome.ended]
        going = [one for one in parts if not one.world.outcome.ended]
    moments.sort(key=lambda row: (row["episode"], row["step"], row["scene"]))
    return moments, _ended(spec, arrived)


def start(spec: Drive, number: int) -> Trajectory:
    """The first moment of an episode, which all of its conditions and seeds share."""
    episodes = [Episode(point, seed) for point in spec.points for seed in spec.seeds]
    return Trajectory(number, World.start(spec.dataset.scenario, spec.first_seed + number), episodes)


def frames(latency_s: float) -> int:
    """Whole frames that a decision takes."""
    return math.ceil(latency_s * P.simulation_hz - ROUNDING_FRAMES)


def look(engine: str, trajectory: Trajectory, step: int) -> Scene:
    """What there is to be seen and asked in a trajectory now. The same moment has the same id anywhere."""
    world = trajectory.world
    state = replace(world.state(), step=step)
    # A rule is asked for the ego alone.
    viewers = [state.ego] if engine == "driver" else [state.ego, *state.helpers]
    seen = moment(world, state, trajectory.number, viewers)
    return Scene({**seen, "scene": f"{seen['scene']}-{digest(seen['state'])[:12]}"})


def _decide(
    spec: Drive, backend: Backend, latency: Mapping[str, Any], going: Sequence[Trajectory], step: int
) -> list[record.Row]:
    """Begin every decision that is due; a row a moment."""
    deciding: list[tuple[Trajectory, list[Episode]]] = []
    for one in going:
        for episode in one.episodes:
            episode.skipped += episode.open is not None
        if free := [episode for episode in one.episodes if episode.open is None]:
            deciding.append((one, free))
    if not deciding:
        return []
    scenes = tuple(look(spec.card.engine, one, step) for one, _ in deciding)
    asked = list(requests(spec, scenes))
    by_id = {r.id: answer_of(r, c) for r, c in zip(asked, backend.complete(asked), strict=True)}
    live_scenes = replace(spec.dataset, scenes=scenes)
    known = intents(live_scenes, by_id, spec.answer, spec.thinking)
    seconds = inference_s(latency, known.answers)
    rounds = [
        _Round(point, step, scenes, known, seconds, places)
        for point in spec.points
        if (places := [(n, e) for n, (_, free) in enumerate(deciding) for e in free if e.point is point])
    ]
    second = _asked_again(replace(spec, dataset=live_scenes), backend, latency, known, rounds)
    for one_round in rounds:
        one_round.decide(spec.dataset.actions, second)
    made = [[e.decisions[-1] for e in free] for _, free in deciding]
    return record.moments(scenes, known, made, second)


@dataclass(frozen=True)
class _Round:
    """One condition's decisions at one time, each a place among the scenes and an episode."""

    point: OperatingPoint
    step: int
    scenes: Sequence[Scene]
    known: Intents
    seconds: Floats
    places: Sequence[tuple[int, Episode]]

    @cached_property
    def at(self) -> Ints:
        """(n,) the scene of each decision."""
        return np.array([n for n, _ in self.places])

    @cached_property
    def inputs(self) -> dict[str, Any]:
        """What `exchange` wants."""
        at, known = self.at, self.known
        helpers = known.valid.shape[1]
        drawn = [_luck(e.seed, self.scenes[n].state.episode_seed, helpers) for n, e in self.places]
        luck = Luck(np.array([d[:2].T for d in drawn]), np.array([d[2 + self.step] for d in drawn]))
        return {
            "point": self.point, "own": known.own[at], "helpers": known.helpers[at], "valid": known.valid[at],
            "range_m": known.range_m[at], "payload_bits": known.payload_bits[at],
            "infer_s": np.nan_to_num(self.seconds[at]), "luck": luck,
        }  # fmt: skip

    def codes(self) -> Ints:
        """Sets of messages that the ego's model is to merge."""
        on_time = exchange(**self.inputs).on_time
        return merging.codes_of(on_time, self.at)[on_time.any(axis=1)]

    def decide(self, actions: Sequence[str], second: Merged | None) -> None:
        """Open every decision."""
        merge = partial(second, at=self.at) if second else None
        result = coordinate(**self.inputs, distance_m=self.known.distance_m[self.at], merge=merge)
        begun = round(self.step * P.decision_period_s * P.simulation_hz)
        viewers = [self.scenes[n].viewers[1:] for n, _ in self.places]
        made = record.decisions(result, self.point, [e.seed for _, e in self.places], viewers, actions)
        ready = [begun + frames(latency_s) for latency_s in result.latency_s.tolist()]
        for (_, episode), decision, frame in zip(self.places, made, ready, strict=True):
            decision["acts_at_s"] = frame / P.simulation_hz
            episode.decisions.append(decision)
            episode.open = Decision(decision["action"], frame, decision)


def _asked_again(
    spec: Drive, backend: Backend, latency: Mapping[str, Any], known: Intents, rounds: Sequence[_Round]
) -> Merged | None:
    """The ego's second answers, where a condition has its model merge messages; empty if nobody was heard."""
    found = [one.codes() for one in rounds if one.point.asks_again]
    if not found:
        return None
    codes = np.unique(np.concatenate(found))
    asked = list(merging.requests(spec, known, codes))
    completions = backend.complete(asked) if asked else []
    answers = [answer_of(r, c) for r, c in zip(asked, completions, strict=True)]
    return merging.merged(spec, codes, answers, merge_s(latency, answers))


@lru_cache(maxsize=4096)
def _luck(seed: int, layout_seed: int, helpers: int) -> Any:
    """The channel's draws for an episode, (2 + decisions, helpers): the very ones of a frozen run."""
    return luck.uniforms((2 + P.decisions, helpers), "channel", seed, layout_seed)


def _ended(spec: Drive, arrived: Sequence[Trajectory]) -> list[record.Row]:
    """A row an episode, held against a full-view driver that thinks in no time."""
    references = {
        number: live.drive(spec.dataset.scenario, PRIVILEGED, spec.first_seed + number)
        for number in sorted({one.number for one in arrived if one.world.outcome.success})
    }
    rows = [
        record.ended(one, episode, references.get(one.number)) for one in arrived for episode in one.episodes
    ]
    order = {(point.name, seed): n for n, (point, seed) in enumerate(
        (point, seed) for point in spec.points for seed in spec.seeds)}  # fmt: skip
    return sorted(rows, key=lambda row: (row["episode"], order[row["condition"], row["seed"]]))
