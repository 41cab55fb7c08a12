"""Replay a closed-loop episode from its record:
equal actions in equal frames give an equal world.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest

import numpy as np

from harness.backends.registry import registration
from harness.core.errors import printable
from harness.dataset.load import Scene
from harness.evaluate.live_world import looks
from harness.runs.folder import Run
from harness.runs.records import ClosedLoop, Decision, Manifest
from harness.world import lockstep
from harness.world.parameters import Parameters
from harness.world.scenario import Scenario
from harness.world.seats import offset_of
from harness.world.world import World

AT_ONCE = 128  # decision points that are replayed together, which bounds memory


@dataclass(frozen=True)
class ReplayedEpisode:
    """Hold the recorded decisions of one episode of a closed-loop run, to play it again.

    `layout_seed` draws its start situation, `seed` is that of the channel's random numbers,
    `condition` the name of the settings under which it was driven, and `manifest` the run's.
    """

    manifest: Manifest  # the run's manifest
    condition: str  # name of the condition
    seed: int  # seed of the channel's draws
    episode: int  # the episode's number
    layout_seed: int  # seed of its layout
    decisions: list[Decision]  # its decisions, by step and agent

    @cached_property
    def scenario(self) -> Scenario:
        return self.manifest.scenario.at(self.layout_seed)


def played(run: Run, episode: int, condition: str, seed: int) -> ReplayedEpisode:
    """Return one episode of a closed-loop run, which must have it, with its decisions.

    `episode` is its number, `condition` the name of a set of settings, and `seed` the channel's. In
    closed loop a simulator plays the episodes.
    """
    world, table = run.manifest.world, run.decisions
    assert isinstance(world, ClosedLoop)
    is_episode = (table.whole("episode") == episode) & (table.whole("seed") == seed)
    is_episode &= table.codes("condition", run.conditions) == run.conditions.index(condition)
    rows = table.take(np.flatnonzero(is_episode))
    decisions = sorted(rows.records(0, len(rows)), key=lambda d: (d.step, d.agent or ""))
    return ReplayedEpisode(
        run.manifest, condition, seed, episode, world.first_seed + episode, decisions
    )


def scenes_of(run: Run, names: Sequence[str]) -> list[Scene]:
    """Return the scenes of decision points by id, simulating an episode that reaches each.

    `names` are the ids, and the scenes are in their order. A returned scene has its id only if this
    simulator behaves as the run's did.
    """
    return [
        scene
        for at in range(0, len(names), AT_ONCE)
        for scene in _together(run, names[at : at + AT_ONCE])
    ]


def _together(run: Run, names: Sequence[str]) -> list[Scene]:
    starts = [run.decisions.scenes[name].start for name in names]
    decisions = [run.decisions.records(start, start + 1)[0] for start in starts]
    episodes = [played(run, d.episode, d.condition, d.seed) for d in decisions]
    worlds = [World.start(episode.scenario, episode.layout_seed) for episode in episodes]
    due_frames = [due_frame(world, d) for world, d in zip(worlds, decisions, strict=True)]
    acts = []
    for episode, last in zip(episodes, due_frames, strict=True):
        actions = actions_by_frame(episode).items()
        acts.append([(frame, acting) for frame, acting in actions if frame <= last])
    for turn in zip_longest(*acts):  # each world's next actions, or None
        due = [(world, *act) for world, act in zip(worlds, turn, strict=True) if act]
        lockstep.advance([world for world, _, _ in due], [frame for _, frame, _ in due])
        for world, _, acting in due:
            act(world, acting)
    lockstep.advance(worlds, due_frames)
    where = f"{printable(run.path)}: its model"
    alone = not registration(run.manifest.model["engine"], where).capabilities.asks_helpers
    scenes = dict[int, Scene]()
    for step in {decision.step for decision in decisions}:
        at = [n for n, decision in enumerate(decisions) if decision.step == step]
        points = [
            (worlds[n], _place(worlds[n], decisions[n].agent), decisions[n].episode) for n in at
        ]
        scenes |= zip(at, looks(points, step, alone), strict=True)
    return [scenes[n] for n in range(len(names))]


def due_frame(world: World, decision: Decision) -> int:
    """Return the number of the simulation frame, from 0, in which a decision begins.

    A vehicle may decide later than others, by an offset that the world's seed fixes. `decision` is
    a recorded one of the episode that `world` simulates.
    """
    offset = offset_of(world.scenario, world.seed, _place(world, decision.agent))
    return world.scenario.parameters.due_frame(decision.step) + offset


def actions_by_frame(played: ReplayedEpisode) -> dict[int, list[Decision]]:
    """Return an episode's decisions that took effect, by the number of the simulation frame.

    They are in order of time. `played` is the recorded episode.
    """
    p, acting = played.scenario.parameters, dict[int, list[Decision]]()
    for decision in sorted(
        (d for d in played.decisions if d.acted), key=lambda d: acting_frame(d, p)
    ):
        acting.setdefault(acting_frame(decision, p), []).append(decision)
    return acting


def acting_frame(decision: Decision, p: Parameters) -> int:
    """Return the number of the simulation frame in which a decision took effect; 0 if it never did.

    `p` are the scenario's parameters, with the frames a second.
    """
    return round((decision.acts_at_s or 0.0) * p.simulation_hz)


def act(world: World, decisions: Sequence[Decision]) -> None:
    """Let vehicles of a world take the actions of some decisions now.

    Each decision names the id of its vehicle, or none for the ego.
    """
    for decision in decisions:
        world.take(decision.action, _place(world, decision.agent))


def _place(world: World, agent: str | None) -> int:
    """Return an agent's place among the vehicles; the ego's for None."""
    return [vehicle.spawn.id for vehicle in world.vehicles].index(agent) if agent else 0
