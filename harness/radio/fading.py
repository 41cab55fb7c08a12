"""Random draws of physical radios for shadowing and packets,
keyed by the channel's seed and the layout.

A world may be walked in any order and from any point, so a draw must not depend on the one before
it. Shadowing is therefore a field over the positions of both ends, and not a chain along the trip:
a sum of waves whose directions and lengths are drawn once for a link. With wave vectors of a
multivariate Cauchy distribution its correlation is exp(-moved / decorrelation), that of the usual
chain S' = exp(-moved/D) S + noise, and it is nearly normal (kurtosis 3 - 1.5 / WAVES).
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats, Ints

WAVES = 16
NO_SEED = -1  # in place of the channel's seed, of what belongs to the layout
BLOCK = 1024  # decisions computed at once, so that their waves stay in the processor's cache


@dataclass(frozen=True)
class Trips:
    """Hold the keys from which the channel's random numbers are made, for decisions `(...)`.

    The same keys give the same numbers, whatever else is played.
    """

    seed: Ints  # seed of the channel's draws, `(...)`
    layout_seed: Ints  # seed of the episode's layout, its start situation, `(...)`
    step: Ints  # number of the decision in its episode, from 0, `(...)`
    steps: int  # most decisions of an episode
    # name of the links that the numbers are for, such as those of an antenna on no vehicle; empty
    # for those among vehicles
    links: str = ""
    # number of each helper in its episode, from 0, which it keeps when others leave, `(..., H)`;
    # None if it is the helper's index
    helpers: Ints | None = None

    def take(self, at: Any) -> "Trips":
        """Return the keys of the decisions at `at`, indices or a mask of the leading axis."""
        helpers = None if self.helpers is None else self.helpers[at]
        keys = self.seed[at], self.layout_seed[at], self.step[at]
        return Trips(*keys, self.steps, self.links, helpers)

    def of_layout(self) -> "Trips":
        """Return the keys of numbers that belong to the layout, whatever the channel's seed is."""
        return replace(self, seed=np.full_like(self.seed, NO_SEED))

    def uniforms(self, helpers: int) -> Floats:
        """Return uniform draws in [0, 1) for each decision's packets, `(..., 1 + 2H)`.

        `helpers` is H. The first is for the request's wait for a free medium, then follow a pair
        (request, reply) for each helper.
        """
        pairs_draws, place = self._once_a_pair(_packets, self.steps, self._most(helpers))
        drawn = pairs_draws[place, self.step]
        if self.helpers is None:
            return drawn
        packets = drawn[..., 1:].reshape(*place.shape, -1, 2)
        of_helpers = np.take_along_axis(packets, self.helpers[..., None], axis=-2)
        return np.concatenate([drawn[..., :1], of_helpers.reshape(*place.shape, -1)], axis=-1)

    def shadow(self, xy_m: Floats, decorrelation_m: float) -> Floats:
        """Return the shadowing of the link to each of H helpers, `(..., H)`, standard normal.

        Shadowing is the slow change of received power by what stands around. `xy_m` are positions
        of the ego and its helpers, m, `(..., 1+H, 2)`. The correlation is 1/e when both ends have
        moved `decorrelation_m` (root of the sum of squares).
        """
        helpers = xy_m.shape[-2] - 1
        waves, place = self._once_a_pair(_waves, self._most(helpers))
        ego = np.broadcast_to(xy_m[..., :1, :], xy_m[..., 1:, :].shape)
        ends = (
            np.concatenate([ego, xy_m[..., 1:, :]], axis=-1).reshape(place.size, helpers, 4, 1)
            / decorrelation_m
        )
        place, total = place.reshape(-1), np.empty((place.size, helpers))
        numbers = None if self.helpers is None else self.helpers.reshape(place.size, helpers)
        for start in range(0, len(place), BLOCK):
            block = slice(start, start + BLOCK)
            drawn = waves[place[block]]
            if numbers is not None:
                drawn = np.take_along_axis(drawn, numbers[block, :, None, None], axis=1)
            turns = drawn[..., 0] + np.matmul(drawn[..., 1:], ends[block])[..., 0]
            # The fraction of a turn is exact enough in single precision, whose cosine is much
            # faster.
            angle = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
            total[block] = np.cos(angle).sum(axis=-1)
        return total.reshape(*xy_m.shape[:-2], helpers) * math.sqrt(2 / WAVES)

    def _most(self, helpers: int) -> int:
        """Return for how many helpers to draw, so that each of `helpers` has its number's draws."""
        return helpers if self.helpers is None else int(self.helpers.max(initial=-1)) + 1

    def _once_a_pair(self, drawn: Any, *args: int) -> tuple[Floats, Ints]:
        """Return the draws for each seed and layout, (P, ...),
        and each decision's index in them, `(...)`.
        """
        seeds, seed = np.unique(self.seed, return_inverse=True)
        layouts, layout = np.unique(self.layout_seed, return_inverse=True)
        pairs, place = np.unique(seed * len(layouts) + layout, return_inverse=True)
        keys = zip(
            seeds[pairs // len(layouts)].tolist(),
            layouts[pairs % len(layouts)].tolist(),
            strict=True,
        )
        return np.array([drawn(self.links, *pair, *args) for pair in keys]), place.reshape(
            self.seed.shape
        )


# Helpers' draws follow each other, so that a batch with more helpers changes no other helper's
# draws.
@lru_cache(maxsize=1 << 14)
def _packets(links: str, seed: int, layout_seed: int, steps: int, helpers: int) -> Floats:
    return noise.uniforms((1 + 2 * helpers, steps), f"packets{links}", seed, layout_seed).T


@lru_cache(maxsize=1 << 14)
def _waves(links: str, seed: int, layout_seed: int, helpers: int) -> Floats:
    """Draw phases and 4-dimensional wave vectors, in turns per decorrelation distance,
    (H, WAVES, 5).
    """
    drawn = noise.generator(f"shadowing{links}", seed, layout_seed).standard_normal(
        (helpers, WAVES, 7)
    )
    phase = np.arctan2(drawn[..., :1], drawn[..., 1:2])
    return np.concatenate([phase, drawn[..., 2:6] / np.abs(drawn[..., 6:])], axis=-1) / (2 * np.pi)
