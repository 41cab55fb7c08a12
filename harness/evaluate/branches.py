"""Share one world among the closed-loop episodes that have acted alike so far, and branch it when they part.

Episodes of one layout differ only in condition and seed. They are in one world, which is simulated and
observed once, until one of them takes another action than the rest, or takes it in another frame. Then the
world branches. A branch continues exactly as the undivided world would, to the last bit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

from harness.coordination.operating_point import OperatingPoint
from harness.world import lockstep
from harness.world.world import Target, World


@dataclass
class Decision:
    """A decision of the ego, and when it acts."""

    action: str  # the meta-action
    frame: int  # the frame in which it acts
    acted: bool = False  # whether it has acted
    # least time to collision and post-encroachment time until the next decision begins; inf for none
    ttc_s: float = math.inf
    pet_s: float = math.inf


@dataclass
class Course:
    """One layout under one condition and seed."""

    point: OperatingPoint  # the condition
    seed: int  # seed of the channel's draws
    # the decision that has not acted yet; until it does, the ego keeps to its last action
    open: Decision | None = None
    last: Decision | None = None  # the decision that began last
    skipped: int = 0  # how many decisions did not begin, since one was still open when they were due


@dataclass
class Trajectory:
    """A world, and the courses that share it so far."""

    number: int  # the episode's number
    world: World  # the world
    courses: list[Course]  # the episode under each condition and seed

    def measure(self) -> None:
        """Add the world's conflicts to the last decision of each course, and begin them anew."""
        for decision in (course.last for course in self.courses):
            if decision:
                decision.ttc_s = min(decision.ttc_s, self.world.journey.conflicts.ttc_s)
                decision.pet_s = min(decision.pet_s, self.world.journey.conflicts.pet_s)
        journey = self.world.journey
        journey.conflicts = journey.conflicts.anew()

    def act(self) -> list["Trajectory"]:
        """Let the decisions that are ready act; return one trajectory for each target the egos then have."""
        target_now = self.world.target()
        worlds, courses = {target_now: self.world}, {target_now: list[Course]()}
        target_of: dict[str, Target] = {}
        for course in self.courses:
            ready = course.open
            if ready is None or ready.frame > self.world.frame:
                courses[target_now].append(course)
                continue
            if ready.action not in target_of:
                target_of[ready.action] = self.world.target_after(ready.action)
            courses.setdefault(target_of[ready.action], []).append(course)
            ready.acted = True
            course.open = None
        new = {target: action for action, target in target_of.items() if target != target_now}
        for n, (target, action) in enumerate(new.items(), 1):
            nobody_stays = n == len(new) and not courses[target_now]
            worlds[target] = self.world if nobody_stays else self.world.branch()
            worlds[target].take(action)
        return [
            Trajectory(self.number, worlds[target], parted) for target, parted in courses.items() if parted
        ]


def advance(trajectories: Sequence[Trajectory], until_frame: int) -> list[Trajectory]:
    """Simulate up to a frame or the end of each episode; decisions act when they are ready.

    There is one trajectory for each way in which an episode continues, in the order of those given.
    """
    running: list[tuple[tuple[int, ...], Trajectory]] = [((n,), t) for n, t in enumerate(trajectories)]
    arrived = []
    while running:
        frames = [
            min((c.open.frame for c in t.courses if c.open), default=until_frame + 1) for _, t in running
        ]
        lockstep.advance([t.world for _, t in running], [min(frame, until_frame) for frame in frames])
        branched = []
        for (order, trajectory), frame in zip(running, frames, strict=True):
            if trajectory.world.outcome.ended or frame > until_frame:
                arrived.append((order, trajectory))
            else:
                branched += [((*order, -n), part) for n, part in enumerate(trajectory.act())]
        running = branched
    return [trajectory for _, trajectory in sorted(arrived, key=itemgetter(0))]
