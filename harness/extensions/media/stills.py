"""The stills of a driven episode, from its record."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from harness.core.errors import UserError, printable, unknown
from harness.evaluate.replay import (
    ReplayedEpisode,
    act,
    acting_frame,
    actions_by_frame,
    due_frame,
    played,
)
from harness.runs.folder import read
from harness.runs.records import ClosedLoop, Decision
from harness.world.outcome import Outcome
from harness.world.parameters import Parameters
from harness.world.state import WorldState
from harness.world.swarm import gravest
from harness.world.world import World

STILLS_HZ = 10  # while no decision is open


@dataclass(frozen=True)
class Turn:
    """Hold the latest decision of one agent, at the time of a still (a picture of a video).

    An agent is a vehicle that decides for itself, such as the ego. A decision takes time: the agent
    acts on it only when the answers are there.
    """

    decision: Decision  # the decision, open or taken
    since_s: float  # seconds since the decision began
    open: bool  # whether the agent has not acted on it yet
    outcome: str  # how the agent's journey ended; empty until it has


@dataclass(frozen=True)
class Still:
    """Hold the state of an episode at the time of one picture of its video.

    An agent is a vehicle that decides for itself; the ego is one. What an agent decides, it decides
    on what it saw when the decision began.
    """

    state: WorldState  # the state of the world
    seen: WorldState  # the state when the last decision began
    turns: Mapping[str, Turn]  # latest decision of each agent, by its id, the ego first
    outcome: str  # how the episode ended; empty until it has
    # id of the vehicle that the ego would meet if it drove on; None without one
    danger: str | None

    @property
    def since_s(self) -> float:
        """Return the seconds since the last decision of an agent (a vehicle that decides) began."""
        return min(turn.since_s for turn in self.turns.values())


def find(path: Path, episode: int, condition: str | None, seed: int | None) -> ReplayedEpisode:
    """Return one episode of a closed-loop run, with all that replaying it needs.

    A closed-loop run is one that was driven in the simulator. `path` is the run's folder and
    `episode` the episode's number. `condition` names the settings of radio, asking and fusion under
    which it was driven, None for the run's last; `seed` is that of the channel, None for the first.
    Raises UserError if the folder holds no closed-loop run, or lacks one of these.
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


def stills(
    played: ReplayedEpisode, progress: Callable[[int], None] = lambda done: None
) -> Iterator[Still]:
    """Yield the stills of an episode: ten a second, and every frame while a decision is open.

    A decision is open from its beginning until the vehicle acts on it. `progress` is called with 1
    for each still.
    """
    p = played.scenario.parameters
    world = World.start(played.scenario, played.layout_seed)
    acting = actions_by_frame(played)
    starts = [(due_frame(world, decision), decision) for decision in played.decisions]
    due, ids = sorted({frame for frame, _ in starts}), [v.spawn.id for v in world.vehicles]
    # until an agent's own first decision is due, it counts as open
    latest = {decision.agent or ids[0]: decision for _, decision in reversed(starts)}
    seen = world.state()
    while True:
        if due and due[0] <= world.frame:
            now, seen = due.pop(0), world.state()
            latest |= {
                decision.agent or ids[0]: decision for frame, decision in starts if frame == now
            }
        turns = {ids[place]: _turn(world, place, latest[ids[place]], p) for place in world.journeys}
        progress(1)
        yield Still(world.state(), seen, turns, _ending(world), world.layout.danger_id)
        if world.ended:
            return
        deciding = any(turn.open for turn in turns.values())
        next_frame = world.frame + (1 if deciding else max(1, round(p.simulation_hz / STILLS_HZ)))
        world.advance(
            min([next_frame, *(f for f in {*acting, *due} if world.frame < f < next_frame)])
        )
        if world.frame in acting and not world.ended:
            act(world, acting[world.frame])


def _turn(world: World, place: int, decision: Decision, p: Parameters) -> Turn:
    since_s = max(world.frame - due_frame(world, decision), 0) / p.simulation_hz
    ended = world.journeys[place].outcome
    is_open = world.frame < acting_frame(decision, p) and not ended.ended
    return Turn(decision, since_s, is_open, _words(ended))


def _ending(world: World) -> str:
    """Return how an episode ended, empty until it has; with several agents, whose failure it is."""
    if not world.ended:
        return ""
    if len(world.journeys) == 1:
        return _words(world.outcome)
    agent = gravest(world.journeys)
    if agent is None:
        return f"all cleared at {world.time_s:.1f} s"
    return f"{world.vehicles[agent].spawn.id}: {_words(world.journeys[agent].outcome)}"


def _words(outcome: Outcome) -> str:
    if not outcome.ended:
        return ""
    partner = f" with {outcome.partner}" if outcome.partner else ""
    return f"{outcome.result.replace('_', ' ')} at {outcome.time_s:.1f} s{partner}"
