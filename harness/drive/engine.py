"""Drives many episodes in step: at each decision's time one batch of questions, then the time until the next.

Decision k is due at k decision periods. Whoever is asked answers from what it sees in that frame; the action
is taken in the first frame that begins after the decision's latency, and until then the ego keeps to its last
action. A decision that is still open when the next is due goes on, and the next one is skipped.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from harness import live, luck
from harness.backends.base import Backend
from harness.coordination import coordinate
from harness.dataset.freeze import moment
from harness.dataset.load import Scene
from harness.drive import record
from harness.drive.episode import Decision, Episode, Trajectory
from harness.drive.spec import Drive
from harness.drivers import PRIVILEGED
from harness.exchange import Luck
from harness.files import digest
from harness.run.asking import answer_of, requests
from harness.run.intents import Intents, intents
from harness.run.timing import inference_s
from harness.scenarios.occluded_intersection import Parameters
from harness.world import World

P = Parameters()
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
    return Trajectory(number, World.start(spec.first_seed + number), episodes)


def frames(latency_s: float) -> int:
    """Whole frames that a decision takes."""
    return math.ceil(latency_s * P.simulation_hz - ROUNDING_FRAMES)


def look(spec: Drive, trajectory: Trajectory, step: int) -> Scene:
    """What there is to be seen and asked in a trajectory now. The same moment has the same id anywhere."""
    world = trajectory.world
    state = replace(world.state(), step=step)
    # A rule is asked for the ego alone.
    viewers = [state.ego] if spec.card.engine == "driver" else [state.ego, *state.helpers]
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
    scenes = tuple(look(spec, one, step) for one, _ in deciding)
    asked = list(requests(spec, scenes))
    by_id = {r.id: answer_of(r, c) for r, c in zip(asked, backend.complete(asked), strict=True)}
    known = intents(replace(spec.dataset, scenes=scenes), by_id, spec.answer, spec.thinking)
    seconds = inference_s(latency, known.answers)
    for point in spec.points:
        places = [(n, e) for n, (_, free) in enumerate(deciding) for e in free if e.point is point]
        if places:
            _coordinate(spec, known, seconds, scenes, step, places)
    made = [[e.decisions[-1] for e in free] for _, free in deciding]
    return record.moments(scenes, known, made)


def _coordinate(
    spec: Drive, known: Intents, seconds: Any, scenes: Sequence[Scene], step: int,
    places: Sequence[tuple[int, Episode]],
) -> None:  # fmt: skip
    """Make the decisions of one condition's episodes, each in the scene of its place."""
    at = np.array([n for n, _ in places])
    helpers = known.valid.shape[1]
    drawn = [_luck(e.seed, scenes[n].state.episode_seed, helpers) for n, e in places]
    point = places[0][1].point
    result = coordinate(
        point, known.own[at], known.helpers[at], known.valid[at], known.distance_m[at], known.range_m[at],
        known.payload_bits[at], np.nan_to_num(seconds[at]),
        Luck(np.array([d[:2].T for d in drawn]), np.array([d[2 + step] for d in drawn])),
    )  # fmt: skip
    begun = round(step * P.decision_period_s * P.simulation_hz)
    viewers = [scenes[n].viewers[1:] for n in at]
    seeds = [e.seed for _, e in places]
    made = record.decisions(result, point.name, seeds, viewers, spec.dataset.actions)
    for (_, episode), decision, latency_s in zip(places, made, result.latency_s.tolist(), strict=True):
        frame = begun + frames(latency_s)
        decision["acts_at_s"] = frame / P.simulation_hz
        episode.decisions.append(decision)
        episode.open = Decision(decision["action"], frame, decision)


@lru_cache(maxsize=4096)
def _luck(seed: int, layout_seed: int, helpers: int) -> Any:
    """The channel's draws for an episode, (2 + decisions, helpers): the very ones of a frozen run."""
    return luck.uniforms((2 + P.decisions, helpers), "channel", seed, layout_seed)


def _ended(spec: Drive, arrived: Sequence[Trajectory]) -> list[record.Row]:
    """A row an episode, held against a full-view driver that thinks in no time."""
    references = {
        number: live.drive(PRIVILEGED, spec.first_seed + number)
        for number in sorted({one.number for one in arrived if one.world.outcome.success})
    }
    rows = [
        record.ended(one, episode, references.get(one.number)) for one in arrived for episode in one.episodes
    ]
    order = {(point.name, seed): n for n, (point, seed) in enumerate(
        (point, seed) for point in spec.points for seed in spec.seeds)}  # fmt: skip
    return sorted(rows, key=lambda row: (row["episode"], order[row["condition"], row["seed"]]))
