"""A consensus rule that learns whom to trust in the course of an episode.

Each helper has a reputation, the mean of a beta distribution (Jøsang and Ismail 2002), which begins in good
faith and forgets. What speaks against a helper, by the detector classes of ETSI TS 103 759:

- its own past (class 2): between two messages it must have moved as far as the speeds that it claims say, and
  no vehicle is faster than `top_mps`.
- the map (class 3): it must be on a lane, and no two vehicles are in one place.
- own sensors (class 4): where the ego sees the helper, its claimed place must be there; and what it intended
  at the last step is held against the ego's own intent now, the more the surer the ego is.
- other helpers (class 5): how far its intent is from whoever is nearest to it. A witness that sees what
  nobody else does is far from all others too, so once is not enough unless it is very far.

Who is not trusted has no weight. Who is has the weight of Eq. 2, by the place where the ego sees it and not
by the one that it claims.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from harness.coordination.consensus import Fused, Messages, linear_pool
from harness.coordination.trigger import entropy_nats, normalised_entropy
from harness.core.arrays import Bools, Floats

CLAIM = 4  # numbers of a claim that are remembered: place, speed, time


@dataclass(frozen=True)
class Trust:
    """Reputation with memory. All numbers were chosen on layouts of the tuning range (`docs/trust.md`).

    Attributes:
        faith: what speaks for a helper before it has said anything, and against it.
        kept: share of what speaks for and against that is left at the next step.
        contradiction: how much more a full contradiction counts than a full agreement.
        place_tolerance_m: how far a claimed distance may be from the sensed one.
        lane_tolerance_m: how far from the middle of a lane a claimed place may be, beside `noise`.
        speed_tolerance_mps: by how much the mean speed between two claimed places may differ from the mean of
            the claimed speeds, beside `noise`.
        top_mps: faster than that is no vehicle.
        apart_m: nearer to each other two vehicles cannot be.
        noise: how many standard deviations of a beacon's error a true place may be off.
    """

    faith: tuple[float, float] = (2.5, 0.5)
    kept: float = 0.6
    contradiction: float = 4.0
    place_tolerance_m: float = 5.0
    lane_tolerance_m: float = 2.0
    speed_tolerance_mps: float = 2.0
    top_mps: float = 60.0
    apart_m: float = 2.5
    noise: float = 4.0
    needs: ClassVar[tuple[str, ...]] = ("claims",)

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """What speaks for and against each helper, what it intended, and its last claim; nothing yet."""
        state = np.full((*batch, helpers, 2 + actions + CLAIM), np.nan)
        state[..., :2] = self.faith
        return state.reshape(*batch, -1)

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """The linear pool of those that are trusted, the present messages taken into account."""
        p, heard = messages.intents, messages.heard
        remembered = state.reshape(*heard.shape, -1)
        before, claimed = remembered[..., 2:-CLAIM], _claimed(messages)
        against = np.where(
            self._false(messages, claimed, remembered[..., -CLAIM:]), heard, self._against(messages, before)
        )
        counts = np.stack([1 - against, self.contradiction * against], axis=-1)
        # Who is not heard keeps its reputation.
        known = remembered[..., :2]
        reputation = np.where(heard[..., None], self.kept * known + counts, known)
        trust = reputation[..., 0] / np.sum(reputation, axis=-1)
        weights = self._weights(messages, trust)
        intended = np.where(heard[..., None], p[..., 1:, :], before)
        memory = np.concatenate([reputation, intended, claimed], axis=-1).reshape(state.shape)
        return Fused(linear_pool(p, weights), weights, memory, trust)

    def _against(self, messages: Messages, intended: Floats) -> Floats:
        """What speaks against each helper now, from 0 to 1, `(..., H)`."""
        p, heard = messages.intents, messages.heard
        voices = np.insert(heard, 0, True, axis=-1)
        apart = divergence(p[..., 1:, None, :], p[..., None, :, :])
        another = voices[..., None, :] & ~np.eye(p.shape[-2], dtype=bool)[1:]
        from_nearest = np.min(np.where(another, apart, 1.0), axis=-1)
        own = p[..., :1, :]
        later = (1 - normalised_entropy(own)) * np.nan_to_num(divergence(intended, own))
        return np.where(heard, np.maximum(from_nearest, later), 0.0)

    def _false(self, messages: Messages, claimed: Floats, before: Floats) -> Bools:
        """Whether a claimed place or speed cannot be true, `(..., H)`, by claims now and at the last step."""
        if (claims := messages.claims) is None:
            return np.zeros(messages.heard.shape, dtype=bool)
        error_m = self.noise * claims.error_m[..., None]
        seen = ~np.isnan(claims.sensed_m)
        elsewhere = np.abs(messages.distance_m[..., 1:] - claims.sensed_m) > self.place_tolerance_m
        off_road = claims.off_road_m > self.lane_tolerance_m + error_m
        moved = claimed - before
        passed_s, speed_mps = moved[..., 3], np.minimum((claimed + before)[..., 2] / 2, self.top_mps)
        wrong_m = np.abs(np.linalg.norm(moved[..., :2], axis=-1) - speed_mps * passed_s)
        unlike_before = wrong_m > self.speed_tolerance_mps * passed_s + 2 * error_m
        places = claims.xy_m[..., 1:, :]
        between_m = np.linalg.norm(places[..., None, :, :] - places[..., None, :], axis=-1)
        same_place = (between_m < self.apart_m) & ~np.eye(places.shape[-2], dtype=bool)
        overlaps = np.any(same_place, axis=-1) & ~(seen & ~elsewhere)
        return np.asarray(elsewhere | off_road | unlike_before | overlaps)

    def _weights(self, messages: Messages, trust: Floats) -> Floats:
        """Eq. 2 over those that are trusted, by the sensed distance where there is one."""
        claimed_m, sensed_m = messages.distance_m[..., 1:], np.full(trust.shape, np.nan)
        if messages.claims is not None:
            sensed_m = messages.claims.sensed_m
        # Eq. 2 in terms of the weight that the claimed distance gave.
        corrected = messages.weights[..., 1:] * np.where(
            np.isnan(sensed_m), 1.0, np.maximum(claimed_m, 1.0) / np.maximum(sensed_m, 1.0)
        )
        weights = np.concatenate([messages.weights[..., :1], np.where(trust < 0.5, 0.0, corrected)], axis=-1)
        weights = np.where(weights > 0, weights, 0.0)
        return np.asarray(weights / np.sum(weights, axis=-1, keepdims=True))


def _claimed(messages: Messages) -> Floats:
    """Claimed place, speed and time of each helper, `(..., H, CLAIM)`; NaN where nobody looked."""
    if (claims := messages.claims) is None:
        return np.full((*messages.heard.shape, CLAIM), np.nan)
    time_s = np.broadcast_to(claims.time_s[..., None], claims.speed_mps.shape)
    return np.concatenate([claims.xy_m[..., 1:, :], np.stack([claims.speed_mps, time_s], -1)], axis=-1)


def divergence(p: Floats, q: Floats) -> Floats:
    """Jensen-Shannon divergence of distributions `(..., A)`, from 0 for equal to 1 for disjoint ones."""
    apart = entropy_nats((p + q) / 2) - (entropy_nats(p) + entropy_nats(q)) / 2
    return np.asarray(apart / np.log(2))
