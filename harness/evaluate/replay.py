"""A closed-loop episode, replayed from its record: equal actions in equal frames give an equal world."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from harness.backends.registry import capabilities
from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Scene
from harness.evaluate.branches import Trajectory
from harness.evaluate.live_world import look
from harness.runs.folder import Run, read
from harness.runs.records import ClosedLoop, Decision, Manifest
from harness.world import scenarios
from harness.world.scenario import Parameters, Scenario
from harness.world.state import WorldState
from harness.world.world import World

STILLS_HZ = 10  # where no decision is open


@dataclass(frozen=True)
class Played:
    """One episode of a finished closed-loop run.

    Attributes:
        manifest: the run's.
        condition: the operating point.
        seed: seed of the channel's draws.
        episode: its number.
        layout_seed: of its layout.
        decisions: by step.
    """

    manifest: Manifest
    condition: str
    seed: int
    episode: int
    layout_seed: int
    decisions: list[Decision]

    @cached_property
    def scenario(self) -> Scenario:
        """What was driven, with the parameters of then."""
        assert isinstance(self.manifest.world, ClosedLoop)
        of = self.manifest.world.scenario
        return scenarios.stated(of["name"], of["parameters"])


@dataclass(frozen=True)
class Still:
    """One picture of an episode.

    Attributes:
        state: what is where.
        seen: what was there when the last decision began.
        decision: that decision, open or taken.
        since_s: how long ago it began.
        open: whether it does not act yet.
        outcome: how the episode ended; empty until then.
        danger: id of the dangerous vehicle, or None.
    """

    state: WorldState
    seen: WorldState
    decision: Decision
    since_s: float
    open: bool
    outcome: str
    danger: str | None


def find(path: Path, episode: int, condition: str | None, seed: int | None) -> Played:
    """An episode of a run folder; the last condition and the first seed unless others are given.

    Raises:
        UserError: the folder is no closed-loop run, or has no such episode, condition or seed.
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


def played(run: Run, episode: int, condition: str, seed: int) -> Played:
    """An episode that the run has."""
    world, d = run.manifest.world, run.decisions
    assert isinstance(world, ClosedLoop)
    here = (d.whole("episode") == episode) & (d.whole("seed") == seed)
    here &= d.codes("condition", run.conditions) == run.conditions.index(condition)
    mine = d.take(np.flatnonzero(here))
    decisions = sorted(mine.records(0, len(mine)), key=lambda decision: decision.step)
    return Played(run.manifest, condition, seed, episode, world.first_seed + episode, decisions)


def scene_of(run: Run, name: str) -> Scene:
    """A decision point's scene, by replaying one of the episodes that reach it.

    Its id is the decision point's only if this simulator does what the run's did.
    """
    rows = run.decisions.scenes[name]
    [mine] = run.decisions.records(rows.start, rows.start + 1)
    episode = played(run, mine.episode, mine.condition, mine.seed)
    begins = _begins(mine, episode.scenario.parameters)
    world = World.start(episode.scenario, episode.layout_seed)
    for frame, action in _acts(episode).items():
        if frame <= begins:
            world.advance(frame)
            world.take(action)
    world.advance(begins)
    alone = not capabilities(run.manifest.model["engine"]).asks_helpers
    return look(Trajectory(mine.episode, world, []), mine.step, alone)


def _begins(decision: Decision, p: Parameters) -> int:
    return round(decision.step * p.decision_period_s * p.simulation_hz)


def _acts(played: Played) -> dict[int, str]:
    """Actions by the frame in which they were taken."""
    p = played.scenario.parameters
    return {_acts_in(d, p): d.action for d in played.decisions if d.acted}


def _acts_in(decision: Decision, p: Parameters) -> int:
    return round((decision.acts_at_s or 0.0) * p.simulation_hz)


def stills(played: Played, progress: Callable[[int], None] = lambda done: None) -> Iterator[Still]:
    """The episode, ten stills a second, and one a frame while a decision is open."""
    p = played.scenario.parameters
    world = World.start(played.scenario, played.layout_seed)
    begins = [_begins(decision, p) for decision in played.decisions]
    acts = _acts(played)
    place, seen = 0, world.state()
    while True:
        if place + 1 < len(begins) and begins[place + 1] <= world.frame:
            place += 1
            seen = world.state()
        decision = played.decisions[place]
        thinking = world.frame < _acts_in(decision, p)
        outcome = world.outcome
        ending = "" if not outcome.ended else f"{outcome.result.replace('_', ' ')} at {outcome.time_s:.1f} s"
        ending += f" with {outcome.partner}" if outcome.partner else ""
        since_s = (world.frame - begins[place]) / p.simulation_hz
        progress(1)
        is_open = thinking and not outcome.ended
        yield Still(world.state(), seen, decision, since_s, is_open, ending, world.layout.danger_id)
        if outcome.ended:
            return
        until = world.frame + (1 if thinking else max(1, round(p.simulation_hz / STILLS_HZ)))
        for frame in sorted(f for f in {*acts, *begins} if world.frame < f < until):
            until = min(until, frame)
        world.advance(until)
        if world.frame in acts and not world.outcome.ended:
            world.take(acts[world.frame])
