"""An episode of the closed loop, and the world it shares with those that have acted alike so far.

Episodes of one layout differ in condition and seed alone. Until one takes another action than the rest, or
takes it in another frame, they are in one world, which is simulated and observed once. Then the world
branches. A branch continues exactly as the whole would, to the last bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

from harness.coordination.operating_point import OperatingPoint
from harness.world import lockstep
from harness.world.world import Target, World


@dataclass
class Decision:
    """A decision of the ego, and when it acts.

    Attributes:
        action: the meta-action.
        frame: when it acts.
        acted: whether it has.
    """

    action: str
    frame: int
    acted: bool = False


@dataclass
class Course:
    """One layout under one condition and seed.

    Attributes:
        point: the condition.
        seed: seed of the channel's draws.
        open: the decision that does not act yet; the ego keeps to the action before.
        skipped: decisions that did not begin, since one was still open when they were due.
    """

    point: OperatingPoint
    seed: int
    open: Decision | None = None
    skipped: int = 0


@dataclass
class Trajectory:
    """A world, and the courses that have it in common so far.

    Attributes:
        number: the episode's number.
        world: the world.
        courses: of the episode, under conditions and seeds.
    """

    number: int
    world: World
    courses: list[Course]

    def act(self) -> list["Trajectory"]:
        """Let what is ready act; one trajectory for each target that the egos have then."""
        now = self.world.target
        worlds, parted = {now: self.world}, {now: list[Course]()}
        after: dict[str, Target] = {}
        for course in self.courses:
            ready = course.open
            if ready is None or ready.frame > self.world.frame:
                parted[now].append(course)
                continue
            if ready.action not in after:
                after[ready.action] = self.world.target_after(ready.action)
            parted.setdefault(after[ready.action], []).append(course)
            ready.acted = True
            course.open = None
        new = {target: action for action, target in after.items() if target != now}
        for n, (target, action) in enumerate(new.items(), 1):
            nobody_stays = n == len(new) and not parted[now]
            worlds[target] = self.world if nobody_stays else self.world.branch()
            worlds[target].take(action)
        return [Trajectory(self.number, worlds[target], some) for target, some in parted.items() if some]


def advance(trajectories: Sequence[Trajectory], until_frame: int) -> list[Trajectory]:
    """Simulate up to a frame or the end of each episode; decisions act meanwhile.

    Returns:
        One trajectory for each way in which episodes continue, those of one after those of the one before it.
    """
    going: list[tuple[tuple[int, ...], Trajectory]] = [((n,), t) for n, t in enumerate(trajectories)]
    arrived = []
    while going:
        frames = [min((c.open.frame for c in t.courses if c.open), default=until_frame + 1) for _, t in going]
        lockstep.advance([t.world for _, t in going], [min(frame, until_frame) for frame in frames])
        parted = []
        for (place, trajectory), frame in zip(going, frames, strict=True):
            if trajectory.world.outcome.ended or frame > until_frame:
                arrived.append((place, trajectory))
            else:
                parted += [((*place, -n), part) for n, part in enumerate(trajectory.act())]
        going = parted
    return [trajectory for _, trajectory in sorted(arrived, key=itemgetter(0))]
