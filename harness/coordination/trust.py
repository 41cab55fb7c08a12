"""The `trust` rule: a consensus rule that learns during an episode which helpers to trust.

Each helper has a reputation, the mean of a beta distribution (Jøsang and Ismail 2002), which starts
in good faith and forgets. These checks speak against a helper, by the detector classes of ETSI TS
103 759:

- its own past (class 2): between two messages it must have moved as far as its claimed speeds say,
  and no vehicle is faster than `top_mps`.
- the map (class 3): it must be on a lane, and no two vehicles may be in one place.
- own sensors (class 4): if the ego sees the helper, its claimed place must agree. And what the
  helper intended at the last step is compared with the ego's own intent now, with more weight the
  surer the ego is.
- other helpers (class 5): how far its intent is from the nearest intent of another vehicle. A
  witness that sees what nobody else does is also far from all others, so one step is not enough
  unless it is very far.

A helper that is not trusted has no weight. One that is trusted has the weight of Eq. 2, by the
place where the ego sees it and not by the one that it claims.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from harness.coordination.consensus import Fused, Messages, linear_pool
from harness.coordination.trigger import entropy_nats, normalised_entropy
from harness.core.arrays import Bools, Floats, Ints, any_of, least_of, length_of, summed
from harness.core.errors import UserError

COME_AND_GO = (
    "consensus trust: helpers or voices come or go during an episode here, and the rule does not "
    "know one from another; take another rule"
)
CERTAIN = 1e9  # evidence that nothing outweighs
CLAIM = 4  # how many numbers of a claim are remembered: place (two), speed, time


@dataclass(frozen=True)
class Trust:
    """Learn during an episode which helpers to trust, and fuse only the intents of those.

    It is a consensus rule. An intent is the probabilities of the ego's actions. These count against
    a helper: it moves otherwise than its claimed speeds say, or stands off the road or in another
    vehicle; the ego sees it elsewhere than it claims; its last intent contradicts the ego's own
    now, or its intent is far from that of every other vehicle. What counts fades with time. All
    default numbers were chosen on start situations for tuning (`benchmarks/measured/trust.md`).
    """

    # evidence for, and evidence against, a helper before its first message, as in a beta
    # distribution
    faith: tuple[float, float] = (2.5, 0.5)
    # share of the evidence for and against a helper that is left at the next decision
    kept: float = 0.6
    # how many times as much a full contradiction counts as a full agreement
    contradiction: float = 4.0
    # how far a helper's claimed distance to the conflict zone may be from the one that the ego's
    # sensors give, m
    place_tolerance_m: float = 5.0
    # how far from the middle of a lane a claimed place may be, m, in addition to `noise`
    lane_tolerance_m: float = 2.0
    # how much the mean speed between two claimed places may differ from the mean of the claimed
    # speeds, m/s, in addition to `noise`
    speed_tolerance_mps: float = 2.0
    top_mps: float = 60.0  # the highest speed of a vehicle, m/s
    apart_m: float = 2.5  # the smallest distance between two vehicles, m
    noise: float = 4.0  # how many standard deviations of a beacon's error a true place may be off
    # the optional fields of `Messages` that it reads
    needs: ClassVar[tuple[str, ...]] = ("claims", "numbers")

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """Return the rule's memory before the first decision of each episode, `(*batch, K)`.

        `batch` is the shape of the episodes. For each of the `helpers` helpers it has, one after
        another: evidence for and against it, its last intent over A `actions`, and its last claim,
        2 + A + `CLAIM` numbers.
        """
        state = np.full((*batch, helpers, 2 + actions + CLAIM), np.nan)
        state[..., :2] = self.faith
        return state.reshape(*batch, -1)

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Return the policies by the intents of trusted helpers alone, and the trust in each.

        The intents are averaged by weight. Each decision first counts for or against each helper.
        `messages` are of one decision of each episode, and `state`, `(..., K)`, is the memory that
        `start` or the episode's last decision returned. `Fused.trust` has each helper's reputation,
        from 0 to 1, with the present message counted. Raises UserError if there are helpers whom
        the memory does not know.
        """
        p, heard = messages.intents, messages.heard
        memory = state.reshape(*heard.shape[:-1], -1, 2 + p.shape[-1] + CLAIM)
        number = _numbers(messages, memory.shape[-2])[..., None]
        remembered = np.take_along_axis(memory, number, axis=-2)
        last_intents, present_claims = remembered[..., 2:-CLAIM], _claims_of(messages)
        against = np.where(
            self._false(messages, present_claims, remembered[..., -CLAIM:]),
            heard,
            self._against(messages, last_intents),
        )
        counts = np.stack([1 - against, self.contradiction * against], axis=-1)
        # A helper that is not heard keeps its reputation.
        last_reputation = remembered[..., :2]
        reputation = np.where(
            heard[..., None], self.kept * last_reputation + counts, last_reputation
        )
        trust = reputation[..., 0] / summed(reputation, axis=-1)
        weights = self._weights(messages, trust)
        intended = np.where(heard[..., None], p[..., 1:, :], last_intents)
        newer, memory = np.concatenate([reputation, intended, present_claims], -1), memory.copy()
        np.put_along_axis(memory, number, newer, axis=-2)
        return Fused(linear_pool(p, weights), weights, memory.reshape(state.shape), trust)

    def _against(self, messages: Messages, intended: Floats) -> Floats:
        """Return how much speaks against each helper now, from 0 to 1, `(..., H)`."""
        p, heard = messages.intents, messages.heard
        voices = np.insert(heard, 0, True, axis=-1)
        divergences = divergence(p[..., 1:, None, :], p[..., None, :, :])
        other_voices = voices[..., None, :] & ~np.eye(p.shape[-2], dtype=bool)[1:]
        from_nearest = least_of(np.where(other_voices, divergences, 1.0))
        ego = p[..., :1, :]
        against_ego = (1 - normalised_entropy(ego)) * np.nan_to_num(divergence(intended, ego))
        return np.where(heard, np.maximum(from_nearest, against_ego), 0.0)

    def _false(self, messages: Messages, claimed: Floats, last: Floats) -> Bools:
        """Return whose place or speed cannot be true, `(..., H)`,
        by the claims now and one step ago.
        """
        if (claims := messages.claims) is None:
            return np.zeros(messages.heard.shape, dtype=bool)
        error_m = self.noise * claims.error_m[..., None]
        is_seen = ~np.isnan(claims.sensed_m)
        elsewhere = np.abs(messages.distance_m[..., 1:] - claims.sensed_m) > self.place_tolerance_m
        off_road = claims.off_road_m > self.lane_tolerance_m + error_m
        moved = claimed - last
        elapsed_s, speed_mps = moved[..., 3], np.minimum((claimed + last)[..., 2] / 2, self.top_mps)
        discrepancy_m = np.abs(length_of(moved[..., :2]) - speed_mps * elapsed_s)
        contradicts_last = discrepancy_m > self.speed_tolerance_mps * elapsed_s + 2 * error_m
        places = claims.xy_m[..., 1:, :]
        between_m = length_of(places[..., None, :, :] - places[..., None, :])
        same_place = (between_m < self.apart_m) & ~np.eye(places.shape[-2], dtype=bool)
        overlaps = any_of(same_place) & ~(is_seen & ~elsewhere)
        return np.asarray(elsewhere | off_road | contradicts_last | overlaps)

    def _weights(self, messages: Messages, trust: Floats) -> Floats:
        """Return the weights of Eq. 2 for the trusted helpers,
        by the sensed distance if there is one.
        """
        claimed_m, sensed_m = messages.distance_m[..., 1:], np.full(trust.shape, np.nan)
        if messages.claims is not None:
            sensed_m = messages.claims.sensed_m
        # Eq. 2 again, from the weight that the claimed distance gave.
        corrected = messages.weights[..., 1:] * np.where(
            np.isnan(sensed_m), 1.0, np.maximum(claimed_m, 1.0) / np.maximum(sensed_m, 1.0)
        )
        weights = np.concatenate(
            [messages.weights[..., :1], np.where(trust < 0.5, 0.0, corrected)], axis=-1
        )
        weights = np.where(weights > 0, weights, 0.0)
        return np.asarray(weights / np.sum(weights, axis=-1, keepdims=True))


def trusting_only(trusted: Bools, actions: int) -> Floats:
    """Return a memory of the rule that trusts some helpers, whatever they say, and no others.

    It bounds what the rule could be brought to do. `trusted` is a mask of n decisions and H
    helpers, `(n, H)`, and A is the number of `actions`; the result is `(n, K)`.
    """
    state = np.full((*trusted.shape, 2 + actions + CLAIM), np.nan)
    state[..., :2] = np.where(trusted[..., None], (CERTAIN, 0.0), (0.0, CERTAIN))
    return state.reshape(len(trusted), -1)


def _numbers(messages: Messages, helpers: int) -> Ints:
    """Return which of the `helpers` in an episode's memory the present ones are, `(..., H)`."""
    numbers, shape = messages.numbers, messages.heard.shape
    if numbers is None or (numbers < 0).any():  # known by their places alone
        if shape[-1] != helpers:
            raise UserError(COME_AND_GO)
        return np.broadcast_to(np.arange(helpers), shape)
    if numbers.max(initial=-1) >= helpers:
        raise UserError(COME_AND_GO)
    return numbers


def _claims_of(messages: Messages) -> Floats:
    """Return the claimed place, speed and time of each helper, `(..., H, CLAIM)`;
    NaN without claims.
    """
    if (claims := messages.claims) is None:
        return np.full((*messages.heard.shape, CLAIM), np.nan)
    time_s = np.broadcast_to(claims.time_s[..., None], claims.speed_mps.shape)
    return np.concatenate(
        [claims.xy_m[..., 1:, :], np.stack([claims.speed_mps, time_s], -1)], axis=-1
    )


def divergence(p: Floats, q: Floats) -> Floats:
    """Return how far two distributions over A actions are apart, from 0 to 1, `(...)`.

    `p` and `q` are `(..., A)`. It is their Jensen-Shannon divergence, base 2: 0 if they are equal
    and 1 if they have no action in common.
    """
    gained_nats = entropy_nats((p + q) / 2) - (entropy_nats(p) + entropy_nats(q)) / 2
    return np.asarray(gained_nats / np.log(2))
