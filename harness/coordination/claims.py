"""What helpers say of themselves, as far as an ego can check it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Claims:
    """Where helpers say that they are and how fast, and what the ego can hold against it; H helpers.

    Attributes:
        xy_m: place from the centroid of the conflict zone, m to the east and to the south, `(..., 1+H, 2)`,
            the ego first; NaN for a helper that is not there.
        speed_mps: speed, `(..., H)`.
        time_s: when, since the start of the episode, `(...)`.
        error_m: what the beacons' declared noise makes of a true place on each axis, a standard deviation,
            `(...)`.
        sensed_m: the helper's distance to that centroid as the ego's own sensors have it, `(..., H)`; NaN
            where they do not see it.
        from_road_m: the map: metres from places `(..., 2)` to the middle of the nearest lane.
    """

    xy_m: Floats
    speed_mps: Floats
    time_s: Floats
    error_m: Floats
    sensed_m: Floats
    from_road_m: Callable[[Floats], Floats]

    @cached_property
    def off_road_m(self) -> Floats:
        """How far each helper says that it is from the middle of the nearest lane, `(..., H)`."""
        return self.from_road_m(self.xy_m[..., 1:, :])

    def take(self, at: Any) -> "Claims":
        """The claims at these places of the leading dimension."""
        return Claims(
            self.xy_m[at], self.speed_mps[at], self.time_s[at], self.error_m[at], self.sensed_m[at],
            self.from_road_m,
        )  # fmt: skip

    def of_helpers(self, places: Ints) -> "Claims":
        """The same with the helpers of these places, `(..., H')`; one may come again."""
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        return replace(
            self,
            xy_m=np.take_along_axis(self.xy_m, with_ego[..., None], axis=-2),
            speed_mps=np.take_along_axis(self.speed_mps, places, axis=-1),
            sensed_m=np.take_along_axis(self.sensed_m, places, axis=-1),
        )

    def moved(self, by: Bools, xy_m: Floats) -> "Claims":
        """The same where some helpers, `(..., H)`, say that they are at other places, `(..., H, 2)`."""
        ego, helpers = np.split(self.xy_m, [1], axis=-2)
        return replace(self, xy_m=np.concatenate([ego, np.where(by[..., None], xy_m, helpers)], axis=-2))
