"""Replay a closed-loop episode from its record: equal actions in equal frames give an equal world."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from harness.backends.registry import capabilities
from harness.coordination.operating_point import POINTS
from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Scene
from harness.evaluate.branches import Course, Trajectory
from harness.evaluate.live_world import ended, looks
from harness.runs.folder import Run, read
from harness.runs.metrics import BASELINE
from harness.runs.records import ClosedLoop, Decision, Episode, Manifest
from harness.world import lockstep, scenarios
from harness.world.outcome import Outcome
from harness.world.parameters import Parameters
from harness.world.scenario import Scenario
from harness.world.seats import offset_of
from harness.world.state import WorldState
from harness.world.swarm import gravest
from harness.world.world import World

AT_ONCE = 128  # decision points that are replayed together, which bounds memory
STILLS_HZ = 10  # while no decision is open


@dataclass(frozen=True)
class ReplayedEpisode:
    """One episode of a finished closed-loop run."""

    manifest: Manifest  # the run's manifest
    condition: str  # name of the condition
    seed: int  # seed of the channel's draws
    episode: int  # the episode's number
    layout_seed: int  # seed of its layout
    decisions: list[Decision]  # its decisions, by step and agent

    @cached_property
    def scenario(self) -> Scenario:
        assert isinstance(self.manifest.world, ClosedLoop)
        record = self.manifest.world.scenario
        return scenarios.stated(record["name"], record["parameters"])


@dataclass(frozen=True)
class Turn:
    """The decision of an agent that began last."""

    decision: Decision  # the decision, open or taken
    since_s: float  # seconds since it began
    open: bool  # whether it has not acted yet
    outcome: str  # how the agent's journey ended; empty until it has


@dataclass(frozen=True)
class Still:
    """One picture of an episode."""

    state: WorldState  # the state of the world
    seen: WorldState  # the state when the last decision began
    turns: Mapping[str, Turn]  # of each agent, by its id, the ego first
    outcome: str  # how the episode ended; empty until it has
    danger: str | None  # id of the dangerous vehicle, or None

    @property
    def since_s(self) -> float:
        """Seconds since the last decision began."""
        return min(turn.since_s for turn in self.turns.values())


def find(path: Path, episode: int, condition: str | None, seed: int | None) -> ReplayedEpisode:
    """Return an episode of a run folder; by default of the last condition and the first seed.

    Raises UserError if the folder holds no closed-loop run, or has no such episode, condition or seed.
    """
    run = read(path)
    if not isinstance(run.manifest.world, ClosedLoop):
        raise UserError(
            f"{printable(path)} was made by `harness eval`; give a folder made by `harness drive`"
        )
    names, seeds, numbers = run.conditions, run.manifest.seeds, run.grid.episodes
    condition, seed = condition or names[-1], seeds[0] if seed is None else seed
    if condition not in names:
        raise unknown("condition", condition, names)
    if seed not in seeds:
        raise unknown("seed", str(seed), list(map(str, seeds)))
    if episode not in numbers:
        listed = printable(", ".join(map(str, numbers)), 60)
        raise UserError(f"episode {episode} is not in {printable(path)}; give one of {listed}")
    return played(run, episode, condition, seed)


def played(run: Run, episode: int, condition: str, seed: int) -> ReplayedEpisode:
    """Return an episode of a run that is known to have it."""
    world, table = run.manifest.world, run.decisions
    assert isinstance(world, ClosedLoop)
    is_episode = (table.whole("episode") == episode) & (table.whole("seed") == seed)
    is_episode &= table.codes("condition", run.conditions) == run.conditions.index(condition)
    rows = table.take(np.flatnonzero(is_episode))
    decisions = sorted(rows.records(0, len(rows)), key=lambda d: (d.step, d.agent or ""))
    return ReplayedEpisode(run.manifest, condition, seed, episode, world.first_seed + episode, decisions)


def scenes_of(run: Run, names: Sequence[str]) -> list[Scene]:
    """Return decision points' scenes, by replaying together one of the episodes that reach each.

    A scene's id equals its decision point's only if this simulator behaves as the run's did.
    """
    return [
        scene for at in range(0, len(names), AT_ONCE) for scene in _together(run, names[at : at + AT_ONCE])
    ]


def _together(run: Run, names: Sequence[str]) -> list[Scene]:
    starts = [run.decisions.scenes[name].start for name in names]
    decisions = [run.decisions.records(start, start + 1)[0] for start in starts]
    episodes = [played(run, d.episode, d.condition, d.seed) for d in decisions]
    scenario = episodes[0].scenario
    worlds = [World.start(scenario, episode.layout_seed) for episode in episodes]
    due_frames = [_due_frame(world, d) for world, d in zip(worlds, decisions, strict=True)]
    acts = [
        [(frame, acting) for frame, acting in _actions_by_frame(episode).items() if frame <= due_frame]
        for episode, due_frame in zip(episodes, due_frames, strict=True)
    ]
    for turn in zip_longest(*acts):  # each world's next actions, or None
        due = [(world, *act) for world, act in zip(worlds, turn, strict=True) if act]
        lockstep.advance([world for world, _, _ in due], [frame for _, frame, _ in due])
        for world, _, acting in due:
            _act(world, acting)
    lockstep.advance(worlds, due_frames)
    alone = not capabilities(run.manifest.model["engine"]).asks_helpers
    scenes = dict[int, Scene]()
    for step in {decision.step for decision in decisions}:
        at = [n for n, decision in enumerate(decisions) if decision.step == step]
        points = [(worlds[n], _place(worlds[n], decisions[n].agent), decisions[n].episode) for n in at]
        scenes |= zip(at, looks(points, step, alone), strict=True)
    return [scenes[n] for n in range(len(names))]


def _due_frame(world: World, decision: Decision) -> int:
    offset = offset_of(world.scenario, world.seed, _place(world, decision.agent))
    return world.scenario.parameters.due_frame(decision.step) + offset


def _actions_by_frame(played: ReplayedEpisode) -> dict[int, list[Decision]]:
    """Return the decisions that acted, by the frame in which they did, in the order of time."""
    p, acting = played.scenario.parameters, dict[int, list[Decision]]()
    for decision in sorted((d for d in played.decisions if d.acted), key=lambda d: _acting_frame(d, p)):
        acting.setdefault(_acting_frame(decision, p), []).append(decision)
    return acting


def _acting_frame(decision: Decision, p: Parameters) -> int:
    return round((decision.acts_at_s or 0.0) * p.simulation_hz)


def _act(world: World, decisions: Sequence[Decision]) -> None:
    for decision in decisions:
        world.take(decision.action, _place(world, decision.agent))


def _place(world: World, agent: str | None) -> int:
    """Return an agent's place among the vehicles; the ego's for None."""
    return [vehicle.spawn.id for vehicle in world.vehicles].index(agent) if agent else 0


def driven_again(played: ReplayedEpisode) -> Episode:
    """Drive an episode to its end with the recorded actions; return how it ended, without its decisions."""
    world = World.start(played.scenario, played.layout_seed)
    for frame, acting in _actions_by_frame(played).items():
        world.advance(frame)
        if not world.ended:
            _act(world, acting)
    p = played.scenario.parameters
    world.advance(p.due_frame(p.decisions))
    course = Course(POINTS[BASELINE], played.seed)
    [episode] = ended(played.scenario, [Trajectory(played.episode, world, [course])])
    return replace(episode, condition=played.condition)


def stills(played: ReplayedEpisode, progress: Callable[[int], None] = lambda done: None) -> Iterator[Still]:
    """Yield the stills of an episode: ten a second, and one each frame while a decision is open."""
    p = played.scenario.parameters
    world = World.start(played.scenario, played.layout_seed)
    acting = _actions_by_frame(played)
    begun = [(_due_frame(world, decision), decision) for decision in played.decisions]
    due, ids = sorted({frame for frame, _ in begun}), [v.spawn.id for v in world.vehicles]
    # until an agent's own first decision is due, it counts as open
    latest = {decision.agent or ids[0]: decision for _, decision in reversed(begun)}
    seen = world.state()
    while True:
        if due and due[0] <= world.frame:
            now, seen = due.pop(0), world.state()
            latest |= {decision.agent or ids[0]: decision for frame, decision in begun if frame == now}
        turns = {ids[place]: _turn(world, place, latest[ids[place]], p) for place in world.journeys}
        progress(1)
        yield Still(world.state(), seen, turns, _ending(world), world.layout.danger_id)
        if world.ended:
            return
        deciding = any(turn.open for turn in turns.values())
        next_frame = world.frame + (1 if deciding else max(1, round(p.simulation_hz / STILLS_HZ)))
        world.advance(min([next_frame, *(f for f in {*acting, *due} if world.frame < f < next_frame)]))
        if world.frame in acting and not world.ended:
            _act(world, acting[world.frame])


def _turn(world: World, place: int, decision: Decision, p: Parameters) -> Turn:
    since_s = max(world.frame - _due_frame(world, decision), 0) / p.simulation_hz
    outcome = world.journeys[place].outcome
    is_open = world.frame < _acting_frame(decision, p) and not outcome.ended
    return Turn(decision, since_s, is_open, _said(outcome))


def _ending(world: World) -> str:
    """Return how an episode ended, empty until it has; with several agents, whose failure it is."""
    if not world.ended:
        return ""
    if len(world.journeys) == 1:
        return _said(world.outcome)
    agent = gravest(world.journeys)
    if agent is None:
        return f"all cleared at {world.time_s:.1f} s"
    return f"{world.vehicles[agent].spawn.id}: {_said(world.journeys[agent].outcome)}"


def _said(outcome: Outcome) -> str:
    if not outcome.ended:
        return ""
    partner = f" with {outcome.partner}" if outcome.partner else ""
    return f"{outcome.result.replace('_', ' ')} at {outcome.time_s:.1f} s{partner}"
