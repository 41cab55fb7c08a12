"""A live episode, and the world it shares with those that have gone the same way so far.

Episodes of one layout differ in condition and seed alone. Until one takes another action than the rest, or
takes it in another frame, they are in one and the same world: it is simulated, seen and asked once. There the
world branches. A branch goes on to the last bit as the whole would have.
"""

from dataclasses import dataclass, field
from typing import Any

from harness.coordination.operating_point import OperatingPoint
from harness.world.world import World


@dataclass
class Decision:
    """A decision that is made but does not act yet.

    Attributes:
        action: the meta-action.
        frame: when it acts.
        made: its record; `acted` becomes true when it has.
    """

    action: str
    frame: int
    made: dict[str, Any]


@dataclass
class Episode:
    """One layout under one condition and seed.

    Attributes:
        point: the condition.
        seed: seed of the channel's luck.
        open: the decision that is still being made; its ego keeps to the action before.
        decisions: records of all decisions so far.
        skipped: decisions that were not begun, since one was still open when they were due.
    """

    point: OperatingPoint
    seed: int
    open: Decision | None = None
    decisions: list[dict[str, Any]] = field(default_factory=list)
    skipped: int = 0


@dataclass
class Trajectory:
    """A world, and the episodes that have it in common so far.

    Attributes:
        number: the episodes' number.
        world: the world.
        episodes: whoever is in it.
    """

    number: int
    world: World
    episodes: list[Episode]

    def advance(self, until_frame: int) -> list["Trajectory"]:
        """Live on until so many frames are simulated or the episode is decided; decisions act meanwhile.

        Returns:
            What has become of it: one trajectory for each way that its episodes have gone.
        """
        going, arrived = [self], []
        while going:
            one = going.pop()
            frame = min((e.open.frame for e in one.episodes if e.open), default=until_frame + 1)
            one.world.advance(min(frame, until_frame))
            if one.world.outcome.ended or frame > until_frame:
                arrived.append(one)
            else:
                going += one._act()
        return arrived

    def _act(self) -> list["Trajectory"]:
        """Let what is ready act; one trajectory for each target speed that the egos have then."""
        now = self.world.speed_index
        worlds, parted = {now: self.world}, {now: list[Episode]()}
        after: dict[str, int] = {}
        for episode in self.episodes:
            ready = episode.open
            if ready is None or ready.frame > self.world.frame:
                parted[now].append(episode)
                continue
            if ready.action not in after:
                after[ready.action] = self.world.speed_index_after(ready.action)
            parted.setdefault(after[ready.action], []).append(episode)
            ready.made["acted"] = True
            episode.open = None
        new = {index: action for action, index in after.items() if index != now}
        for n, (index, action) in enumerate(new.items(), 1):
            nobody_stays = n == len(new) and not parted[now]
            worlds[index] = self.world if nobody_stays else self.world.branch()
            worlds[index].take(action)
        return [Trajectory(self.number, worlds[index], some) for index, some in parted.items() if some]
