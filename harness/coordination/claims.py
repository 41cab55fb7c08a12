"""Define `Claims`: what helpers claim about themselves, as far as an ego can check it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Maps:
    """Measure how far places are from the lanes, of decisions that are on roads of their own."""

    # of each road: takes places, (..., 2) m from the centroid of its conflict zone, and returns the
    # distance of each to the middle of the nearest lane, m, (...)
    from_road_m: Sequence[Callable[[Floats], Floats]]
    road: Ints  # number of the road of each decision, (...)

    def __call__(self, xy_m: Floats) -> Floats:
        """Return the distances, m, (...), of places (..., 2); decisions are the leading axes."""
        inner = (1,) * (xy_m.ndim - 1 - self.road.ndim)
        road = np.broadcast_to(self.road.reshape(self.road.shape + inner), xy_m.shape[:-1])
        metres = np.full(xy_m.shape[:-1], np.nan)
        for number in np.unique(road).tolist():
            metres[road == number] = self.from_road_m[number](xy_m[road == number])
        return metres

    def take(self, at: Any) -> "Maps":
        return Maps(self.from_road_m, np.asarray(self.road[at]))


@dataclass(frozen=True)
class Claims:
    """Hold the positions and speeds that H helpers claim, and what the ego can check them by.

    Helpers claim them in their beacons, broadcasts about themselves. The conflict zone is where
    their paths and the ego's meet. Arrays are of decisions of any shape `(...)`. On an axis of
    length 1+H index 0 is the ego and 1+h is helper h; on one of length H, index h is helper h.
    """

    # claimed places, m to the east and to the south of the centroid of the conflict zone,
    # `(..., 1+H, 2)`; NaN for a helper that is absent
    xy_m: Floats
    speed_mps: Floats  # each helper's claimed speed, m/s, `(..., H)`
    time_s: Floats  # when the claims were made, s since the start of the episode, `(...)`
    # standard deviation on each axis, m, of the errors that beacons declare for their places,
    # `(...)`
    error_m: Floats
    # each helper's distance to that centroid by the ego's own sensors, m, `(..., H)`; NaN if they
    # do not see it
    sensed_m: Floats
    # the map: takes places, m to the east and to the south of that centroid, `(..., 2)`, and
    # returns the distance of each to the middle of the nearest lane, m, `(...)`
    from_road_m: Callable[[Floats], Floats]

    @cached_property
    def off_road_m(self) -> Floats:
        """Return how far each place that a helper claims is from the nearest lane, m, `(..., H)`.

        It is the distance to the lane's middle; a large one speaks against the helper.
        """
        return self.from_road_m(self.xy_m[..., 1:, :])

    def take(self, at: Any) -> "Claims":
        """Return what helpers claim in some of the decisions: those at `at` of the leading axis.

        `at` is an array of indices or a mask.
        """
        maps = self.from_road_m
        some = Claims(
            self.xy_m[at],
            self.speed_mps[at],
            self.time_s[at],
            self.error_m[at],
            self.sensed_m[at],
            maps.take(at) if isinstance(maps, Maps) else maps,
        )
        return some._measured(self.off_road_m[at])

    def of_helpers(self, places: Ints) -> "Claims":
        """Return the claimed positions and speeds with the helpers reordered, chosen or repeated.

        `places`, `(..., H')`, says for each decision which of the H helpers here, by index from 0,
        stands at each of H' places.
        """
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        claims = replace(
            self,
            xy_m=np.take_along_axis(self.xy_m, with_ego[..., None], axis=-2),
            speed_mps=np.take_along_axis(self.speed_mps, places, axis=-1),
            sensed_m=np.take_along_axis(self.sensed_m, places, axis=-1),
        )
        return claims._measured(np.take_along_axis(self.off_road_m, places, axis=-1))

    def moved(self, movers: Bools, xy_m: Floats) -> "Claims":
        """Return the claims with other positions for some helpers, as liars among them state.

        `movers`, `(..., H)`, says which helpers; `xy_m`, `(..., H, 2)`, has their new positions, m
        to the east and to the south of the centroid of the conflict zone.
        """
        ego, helpers = np.split(self.xy_m, [1], axis=-2)
        return replace(
            self, xy_m=np.concatenate([ego, np.where(movers[..., None], xy_m, helpers)], axis=-2)
        )

    def _measured(self, off_road_m: Floats) -> "Claims":
        """Return these claims, which know `off_road_m`: to measure it takes longest of all here."""
        vars(self)["off_road_m"] = off_road_m
        return self
