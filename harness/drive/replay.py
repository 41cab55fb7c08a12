"""A driven episode, played again from its record: the same actions in the same frames give the same world."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.drive.engine import P
from harness.drive.record import Row
from harness.drive.spec import FORMAT
from harness.errors import UserError, printable, unknown
from harness.scene import WorldState
from harness.world import World

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

    config: dict[str, Any]
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


def find(run: Path, episode: int, condition: str | None, seed: int | None) -> Played:
    """An episode of a run folder; the last condition and the first seed unless others are given.

    Raises:
        UserError: the folder is no live run, or has no such episode, condition or seed.
    """
    try:
        config = json.loads((run / "run.json").read_text(encoding="utf-8"))
        if config["format"] != FORMAT:
            raise UserError(f"{printable(run)} is a run of {printable(config['format'])}, and was not driven")
        names, seeds = [c["name"] for c in config["conditions"]], config["seeds"]
        condition, seed = condition or names[-1], seeds[0] if seed is None else seed
        if condition not in names:
            raise unknown("condition", condition, names)
        if seed not in seeds:
            raise unknown("seed", str(seed), list(map(str, seeds)))
        if not 0 <= episode < config["episodes"]:
            raise UserError(
                f"episode {episode} is not in {printable(run)}; give 0 to {config['episodes'] - 1}"
            )
        moments, decisions = [], []
        for line in (run / "rows.jsonl").read_text(encoding="utf-8").split("\n")[:-1]:
            row = json.loads(line)
            for made in row["decisions"] if row["episode"] == episode else ():
                if (made["condition"], made["seed"]) == (condition, seed):
                    moments.append(row)
                    decisions.append(made)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{printable(run)} is no live run ({printable(error)}); give a folder made by `harness drive`"
        ) from None
    return Played(config, condition, seed, episode, moments, decisions)


def stills(played: Played, progress: Callable[[int], None] = lambda done: None) -> Iterator[Still]:
    """The episode, ten stills a second, and one a frame while a decision is open."""
    hz = P.simulation_hz
    world = World.start(played.config["first_seed"] + played.episode)
    begins = [round(row["step"] * P.decision_period_s * hz) for row in played.moments]
    acts = {round(d["acts_at_s"] * hz): d["action"] for d in played.decisions if d["acted"]}
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
