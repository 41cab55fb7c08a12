"""A driven episode, played again from its record: the same actions in the same frames give the same world."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Scene
from harness.evaluate.branches import Trajectory
from harness.evaluate.live import SCENARIO, P, look
from harness.runs.driven_folder import read
from harness.runs.folder import Row, Run
from harness.world.state import WorldState
from harness.world.world import World

EVERY_FRAMES = 5  # between two stills, where no decision is open


@dataclass(frozen=True)
class Played:
    """One episode of a finished live run.

    Attributes:
        config: the run's manifest.
        condition: the operating point.
        seed: seed of the channel's luck.
        episode: its number.
        moments: rows of its decisions, by step.
        decisions: what it made of them, in the same order.
    """

    config: Mapping[str, Any]
    condition: str
    seed: int
    episode: int
    moments: list[Row]
    decisions: list[Row]


@dataclass(frozen=True)
class Still:
    """One moment to be drawn.

    Attributes:
        state: what is where.
        seen: what was there when the last decision began.
        decision: that decision, open or taken.
        since_s: how long ago it began.
        open: whether it is still being made.
        outcome: what has become of the episode; empty while it goes on.
    """

    state: WorldState
    seen: WorldState
    decision: Row
    since_s: float
    open: bool
    outcome: str


def find(path: Path, episode: int, condition: str | None, seed: int | None) -> Played:
    """An episode of a run folder; the last condition and the first seed unless others are given.

    Raises:
        UserError: the folder is no live run, or has no such episode, condition or seed.
    """
    run = read(path)
    names, seeds = run.conditions, run.config["seeds"]
    condition, seed = condition or names[-1], seeds[0] if seed is None else seed
    if condition not in names:
        raise unknown("condition", condition, names)
    if seed not in seeds:
        raise unknown("seed", str(seed), list(map(str, seeds)))
    if not 0 <= episode < run.config["episodes"]:
        raise UserError(
            f"episode {episode} is not in {printable(path)}; give 0 to {run.config['episodes'] - 1}"
        )
    return played(run, episode, condition, seed)


def played(run: Run, episode: int, condition: str, seed: int) -> Played:
    """An episode that the run has."""
    found = [
        (row, made)
        for row in run.rows
        if row["episode"] == episode
        for made in row["decisions"]
        if (made["condition"], made["seed"]) == (condition, seed)
    ]
    return Played(
        run.config, condition, seed, episode, [row for row, _ in found], [made for _, made in found]
    )


def scene_of(run: Run, row: Row) -> Scene:
    """What there was to be seen in a moment, had by playing one of the episodes in it again.

    Its id is the row's only where this simulator does what the run's did.
    """
    mine, hz = row["decisions"][0], P.simulation_hz
    episode = played(run, row["episode"], mine["condition"], mine["seed"])
    begins = round(row["step"] * P.decision_period_s * hz)
    world = World.start(SCENARIO, run.config["first_seed"] + row["episode"])
    for frame, action in _acts(episode).items():
        if frame <= begins:
            world.advance(frame)
            world.take(action)
    world.advance(begins)
    return look(run.config["model"]["engine"], Trajectory(row["episode"], world, []), row["step"])


def _acts(played: Played) -> dict[int, str]:
    """Actions by the frame in which they were taken."""
    return {round(d["acts_at_s"] * P.simulation_hz): d["action"] for d in played.decisions if d["acted"]}


def stills(played: Played, progress: Callable[[int], None] = lambda done: None) -> Iterator[Still]:
    """The episode, ten stills a second, and one a frame while a decision is open."""
    hz = P.simulation_hz
    world = World.start(SCENARIO, played.config["first_seed"] + played.episode)
    begins = [round(row["step"] * P.decision_period_s * hz) for row in played.moments]
    acts = _acts(played)
    place, seen = 0, world.state()
    while True:
        if place + 1 < len(begins) and begins[place + 1] <= world.frame:
            place += 1
            seen = world.state()
        decision = played.decisions[place]
        thinking = world.frame < round(decision["acts_at_s"] * hz)
        outcome = world.outcome
        told = "" if not outcome.ended else f"{outcome.result.replace('_', ' ')} at {outcome.time_s:.1f} s"
        told += f" with {outcome.partner}" if outcome.partner else ""
        since_s = (world.frame - begins[place]) / hz
        progress(1)
        yield Still(world.state(), seen, decision, since_s, thinking and not outcome.ended, told)
        if outcome.ended:
            return
        until = world.frame + (1 if thinking else EVERY_FRAMES)
        for frame in sorted(f for f in {*acts, *begins} if world.frame < f < until):
            until = min(until, frame)
        world.advance(until)
        if world.frame in acts and not world.outcome.ended:
            world.take(acts[world.frame])
