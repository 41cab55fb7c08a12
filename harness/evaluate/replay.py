"""Replay a closed-loop episode from its record: equal actions in equal frames give an equal world."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path

import numpy as np

from harness.backends.registry import capabilities
from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Scene
from harness.evaluate.live_world import looks
from harness.runs.folder import Run, read
from harness.runs.records import ClosedLoop, Decision, Manifest
from harness.world import lockstep, scenarios
from harness.world.parameters import Parameters
from harness.world.scenario import Scenario
from harness.world.state import WorldState
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
    decisions: list[Decision]  # its decisions, by step

    @cached_property
    def scenario(self) -> Scenario:
        assert isinstance(self.manifest.world, ClosedLoop)
        record = self.manifest.world.scenario
        return scenarios.stated(record["name"], record["parameters"])


@dataclass(frozen=True)
class Still:
    """One picture of an episode."""

    state: WorldState  # the state of the world
    seen: WorldState  # the state when the last decision began
    decision: Decision  # that decision, open or taken
    since_s: float  # seconds since it began
    open: bool  # whether it has not acted yet
    outcome: str  # how the episode ended; empty until it has
    danger: str | None  # id of the dangerous vehicle, or None


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
    decisions = sorted(rows.records(0, len(rows)), key=lambda decision: decision.step)
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
    due_frames = [_due_frame(decision, scenario.parameters) for decision in decisions]
    acts = [
        [(frame, action) for frame, action in _actions_by_frame(episode).items() if frame <= due_frame]
        for episode, due_frame in zip(episodes, due_frames, strict=True)
    ]
    for turn in zip_longest(*acts):  # each world's next action, or None
        acting = [(world, *act) for world, act in zip(worlds, turn, strict=True) if act]
        lockstep.advance([world for world, _, _ in acting], [frame for _, frame, _ in acting])
        for world, _, action in acting:
            world.take(action)
    lockstep.advance(worlds, due_frames)
    alone = not capabilities(run.manifest.model["engine"]).asks_helpers
    scenes = dict[int, Scene]()
    for step in {decision.step for decision in decisions}:
        at = [n for n, decision in enumerate(decisions) if decision.step == step]
        points = [(worlds[n], 0, decisions[n].episode) for n in at]
        scenes |= zip(at, looks(points, step, alone), strict=True)
    return [scenes[n] for n in range(len(names))]


def _due_frame(decision: Decision, p: Parameters) -> int:
    return round(decision.step * p.decision_period_s * p.simulation_hz)


def _actions_by_frame(played: ReplayedEpisode) -> dict[int, str]:
    p = played.scenario.parameters
    return {_acting_frame(d, p): d.action for d in played.decisions if d.acted}


def _acting_frame(decision: Decision, p: Parameters) -> int:
    return round((decision.acts_at_s or 0.0) * p.simulation_hz)


def stills(played: ReplayedEpisode, progress: Callable[[int], None] = lambda done: None) -> Iterator[Still]:
    """Yield the stills of an episode: ten a second, and one each frame while a decision is open."""
    p = played.scenario.parameters
    world = World.start(played.scenario, played.layout_seed)
    due_frames = [_due_frame(decision, p) for decision in played.decisions]
    actions = _actions_by_frame(played)
    index, seen = 0, world.state()
    while True:
        if index + 1 < len(due_frames) and due_frames[index + 1] <= world.frame:
            index += 1
            seen = world.state()
        decision = played.decisions[index]
        deciding = world.frame < _acting_frame(decision, p)
        outcome = world.outcome
        ending = "" if not outcome.ended else f"{outcome.result.replace('_', ' ')} at {outcome.time_s:.1f} s"
        ending += f" with {outcome.partner}" if outcome.partner else ""
        since_s = (world.frame - due_frames[index]) / p.simulation_hz
        progress(1)
        is_open = deciding and not outcome.ended
        yield Still(world.state(), seen, decision, since_s, is_open, ending, world.layout.danger_id)
        if outcome.ended:
            return
        next_frame = world.frame + (1 if deciding else max(1, round(p.simulation_hz / STILLS_HZ)))
        for frame in sorted(f for f in {*actions, *due_frames} if world.frame < f < next_frame):
            next_frame = min(next_frame, frame)
        world.advance(next_frame)
        if world.frame in actions and not world.outcome.ended:
            world.take(actions[world.frame])
