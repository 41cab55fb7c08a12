"""Which part of the world a picture shows: where it is decided, not all of it.

One rule for the report's bird's-eye view, still pictures and videos. It holds the ego, the helpers that were
asked, who is in conflict with the ego, and where paths cross, if they are near the ego.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from harness.core.arrays import Floats
from harness.report.drawing.geometry import VIEW_M, conflict_points, north_up
from harness.world.scene_graph import SceneGraph
from harness.world.state import WorldState

MARGIN_M, LEAST_M = 8.0, 60.0  # around what a view holds; its width
NEAR_M = VIEW_M - MARGIN_M  # what is farther north, south, east or west of the ego than this is not followed
EASE = 8  # stills before a decision in which a video turns to its view


@dataclass(frozen=True)
class View:
    """A rectangle, m to the east and to the north."""

    west_m: float
    south_m: float
    width_m: float
    height_m: float

    @property
    def edges(self) -> Floats:
        """Its south-west and its north-east corner (2, 2)."""
        start = np.array([self.west_m, self.south_m])
        return np.array([start, start + np.array([self.width_m, self.height_m])])

    @property
    def scale(self) -> float:
        """How much is seen of the world, of all of it 1."""
        return self.width_m / (2 * VIEW_M)

    def holds(self, points: Floats, margin_m: float = 0.0) -> bool:
        """Return whether points (..., 2) are in it, and so far from its edge."""
        low, high = self.edges
        return bool(np.all((points >= low + margin_m) & (points <= high - margin_m)))

    def toward(self, target: "View", share: float) -> "View":
        """On the way to another view."""
        return View(
            self.west_m + share * (target.west_m - self.west_m),
            self.south_m + share * (target.south_m - self.south_m),
            self.width_m + share * (target.width_m - self.width_m),
            self.height_m + share * (target.height_m - self.height_m),
        )


def spots(
    state: WorldState, zone_m: tuple[float, float], graph: SceneGraph | None, who: Collection[str | None]
) -> Floats:
    """Return what a picture of a moment holds, (n, 2) m to the east and north, the ego first.

    Args:
        state: who is where.
        zone_m: where paths cross, in the frame of `harness.world.road`.
        graph: of the vehicle whose sight is shown, for the conflicts that it sees; None for no more of them.
        who: ids of whom else it holds: the danger and the helpers that were asked.
    """
    conflicts, crossings = conflict_points(state, graph) if graph else ([], np.empty((0, 2)))
    wanted = {*who, state.ego.id, *(conflict.vehicle for conflict in conflicts)}
    wanted |= {graph.viewer} if graph else set()
    at = [(v.x_m, v.y_m) for v in state.vehicles if v.id in wanted]
    points: Floats = np.concatenate([north_up(np.array([*at, zone_m])), crossings])
    near: Floats = points[np.abs(points - points[0]).max(axis=1) <= NEAR_M]
    return near


def view_of(held: Floats, shape: float = 1.0) -> View:
    """Return what holds spots (n, 2) with a margin, in the middle of it if the world goes on that far.

    Its height is `shape` times its width.
    """
    low, high = held.min(axis=0), held.max(axis=0)
    shapes = np.array([1.0, shape])
    size = shapes * max(LEAST_M, float(((high - low + 2 * MARGIN_M) / shapes).max()))
    room = np.maximum(VIEW_M - size / 2, 0.0)
    middle = ((low + high) / 2).clip(-room, room).clip(high + MARGIN_M - size / 2, low - MARGIN_M + size / 2)
    return View(*map(float, (*(middle - size / 2), *size)))


def views(held: Sequence[Floats], parts: Sequence[int], shape: float = 1.0) -> list[View]:
    """A view for each still of a video: held through each part, it turns to the next in its last stills.

    Args:
        held: spots of each still.
        parts: the part that each still is of, such as the decision, in order.
        shape: height by width.
    """
    starts = [0, *(n for n, (a, b) in enumerate(pairwise(parts), 1) if a != b), len(parts)]
    turns = [begin if begin == 0 else max(begin - EASE, last) for last, begin in pairwise([0, *starts[:-1]])]
    # What is on its way from one part into the next is in the views of both, and so in all between them.
    targets = [
        view_of(np.concatenate(held[turn:end]), shape) for turn, end in zip(turns, starts[1:], strict=True)
    ]
    stills = []
    for n, target in enumerate(targets):
        turn, end = turns[n + 1] if n + 1 < len(targets) else starts[n + 1], starts[n + 1]
        stills += [target] * (turn - starts[n])
        for still in range(turn, end):
            share = (still - turn + 1) / (end - turn + 1)
            stills.append(target.toward(targets[n + 1], share * share * (3 - 2 * share)))
    return stills
