"""Say whether who strikes the ego could have stopped: its course again, with full braking."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.core.errors import unknown
from harness.extensions.roads.replay import Play
from harness.world.scenario import Scenario
from harness.world.world import World


@dataclass(eq=False)
class FullBraking(Play):
    """Move road users as ever, but one as if it knew that the ego will not get out of its way.

    It brakes as hard as anybody may whenever the ego is off the recording and stands with its
    outline on the path ahead, however far.
    """

    striker: int = 0  # the number of who does

    def _excess(self, off: Bools) -> Floats:
        excess = super()._excess(off)
        far_m = np.full(len(self.arc_m), np.inf)
        at = self.cast.paths.ahead(np.array([self.striker]), self.arc_m, far_m)
        ego = np.zeros(len(at), dtype=int)
        if off[0] and self.cast.contacts(at, ego, self.arc_m, self.poses)[0].size:
            excess[self.striker] = np.inf
        return excess


def could_stop(scenario: Scenario, seed: int, actions: Sequence[str], striker: str) -> bool:
    """Return whether a crash does not happen if who strikes the ego brakes as hard as it may.

    The course of a layout's `seed` is played again with the ego's `actions`, and the other, whose
    id is `striker`, brakes from the first frame on in which the ego stands in its way. Raises
    UserError if nobody of the layout has that id.
    """
    world = World.start(scenario, seed)
    road = world.env.road  # type: ignore[attr-defined]
    parts = {field.name: getattr(road.play, field.name) for field in fields(Play)}
    numbers = {f"v{number + 1}": number for number in range(1, len(road.play.cast.tracks))}
    if striker not in numbers:
        hint = "; run `harness dataset check`"
        raise unknown(f"road user of layout {seed}", striker, numbers, hint)
    road.play = FullBraking(**parts, striker=numbers[striker])
    for action in actions:
        world.act(action)
    return world.outcome.result != "collision" or world.outcome.partner != striker
