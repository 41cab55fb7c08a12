"""The least gap between the ego's outline and another's."""

import numpy as np
import shapely

from harness.core.arrays import Floats, Ints
from harness.world.state import rectangle, separation_m


def least_gaps_m(poses: Floats, sizes_m: Floats, least_m: Floats) -> Floats:
    """Return the least gap so far between the ego's outline and any other vehicle's, (W,) m.

    It is of each of W simulated episodes, over F more frames. `poses` are x and y (m) and heading
    (rad), then anything, of V vehicles, (W, F, V, 3 or more), the ego first, NaN where there is no
    vehicle. `sizes_m` are their lengths and widths, (W, V, 2). `least_m`, (W,), is the least gap of
    earlier frames; no result exceeds it.
    """
    centres_m = np.hypot(*np.moveaxis(poses[:, :, 1:, :2] - poses[:, :, :1, :2], -1, 0))
    # Two centres are at least both half widths apart from touching, and at most both half
    # diagonals.
    farthest_m = np.hypot(*np.moveaxis(sizes_m, -1, 0))[:, None]
    most_m = centres_m - (sizes_m[:, None, :1, 1] + sizes_m[:, None, 1:, 1]) / 2
    bound_m = np.fmin(least_m, np.fmin.reduce(most_m, axis=(1, 2), initial=np.inf))
    close = centres_m - (farthest_m[..., :1] + farthest_m[..., 1:]) / 2 <= bound_m[:, None, None]
    worlds, frames, vehicles = np.nonzero(close)
    egos, egos_m = poses[worlds, frames, 0, :3], sizes_m[worlds, 0]
    others, others_m = poses[worlds, frames, 1 + vehicles, :3], sizes_m[worlds, 1 + vehicles]
    at_least_m = separation_m(egos, egos_m, others, others_m)
    gaps_m = least_m.copy()

    def measure(pairs: Ints) -> None:
        """Lower the gap of each world to those of some pairs of vehicles."""
        of_egos = shapely.polygons(rectangle(*egos[pairs].T, *egos_m[pairs].T))
        of_others = shapely.polygons(rectangle(*others[pairs].T, *others_m[pairs].T))
        np.minimum.at(gaps_m, worlds[pairs], shapely.distance(of_egos, of_others))

    # The pair with the smallest bound in each world is measured first; few others can then be
    # nearer.
    likely = np.lexsort((at_least_m, worlds))
    measure(likely[np.diff(worlds[likely], prepend=-1) > 0])
    measure(np.flatnonzero(at_least_m < gaps_m[worlds]))
    return gaps_m
