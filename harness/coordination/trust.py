"""A consensus rule that learns whom to trust in the course of an episode.

Each helper has a reputation, the mean of a beta distribution (Jøsang and Ismail 2002), which begins in good
faith and forgets. What speaks against a helper, by the detector classes of ETSI TS 103 759:

- own sensors (class 4): where the ego sees the helper, its claimed place must be there; and what it intended
  at the last step is held against the ego's own intent now, the more the surer the ego is.
- other helpers (class 5): how far its intent is from whoever is nearest to it. A witness that sees what
  nobody else does is far from all others too, so once is not enough unless it is very far.

Who is not trusted has no weight. Who is has the weight of Eq. 2, by the place where the ego sees it and not
by the one that it claims.
"""

from dataclasses import dataclass

import numpy as np

from harness.coordination.consensus import Fused, Messages, linear_pool
from harness.coordination.trigger import entropy_nats, normalised_entropy
from harness.core.arrays import Floats


@dataclass(frozen=True)
class Trust:
    """Reputation with memory. All numbers were chosen on layouts of the tuning range (`docs/trust.md`).

    Attributes:
        faith: what speaks for a helper before it has said anything, and against it.
        kept: share of what speaks for and against that is left at the next step.
        contradiction: how much more a full contradiction counts than a full agreement.
        place_tolerance_m: how far a claimed distance may be from the sensed one.
    """

    faith: tuple[float, float] = (2.5, 0.5)
    kept: float = 0.6
    contradiction: float = 4.0
    place_tolerance_m: float = 5.0

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """What speaks for and against each helper, and what it intended; nothing yet."""
        state = np.full((*batch, helpers, 2 + actions), np.nan)
        state[..., :2] = self.faith
        return state.reshape(*batch, -1)

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """The linear pool of those that are trusted, the present messages taken into account."""
        p, heard = messages.intents, messages.heard
        remembered = state.reshape(*heard.shape, -1)
        against = self._against(messages, remembered[..., 2:])
        counts = np.stack([1 - against, self.contradiction * against], axis=-1)
        # Who is not heard keeps its reputation.
        before = remembered[..., :2]
        reputation = np.where(heard[..., None], self.kept * before + counts, before)
        trust = reputation[..., 0] / np.sum(reputation, axis=-1)
        weights = self._weights(messages, trust)
        intended = np.where(heard[..., None], p[..., 1:, :], remembered[..., 2:])
        memory = np.concatenate([reputation, intended], axis=-1).reshape(state.shape)
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
        place_m = np.nan_to_num(np.abs(messages.distance_m[..., 1:] - messages.sensed_m))
        elsewhere = place_m > self.place_tolerance_m
        return np.where(heard, np.maximum(np.maximum(from_nearest, later), elsewhere), 0.0)

    def _weights(self, messages: Messages, trust: Floats) -> Floats:
        """Eq. 2 over those that are trusted, by the sensed distance where there is one."""
        claimed_m, sensed_m = messages.distance_m[..., 1:], messages.sensed_m
        # Eq. 2 in terms of the weight that the claimed distance gave.
        corrected = messages.weights[..., 1:] * np.where(
            np.isnan(sensed_m), 1.0, np.maximum(claimed_m, 1.0) / np.maximum(sensed_m, 1.0)
        )
        weights = np.concatenate([messages.weights[..., :1], np.where(trust < 0.5, 0.0, corrected)], axis=-1)
        weights = np.where(weights > 0, weights, 0.0)
        return np.asarray(weights / np.sum(weights, axis=-1, keepdims=True))


def divergence(p: Floats, q: Floats) -> Floats:
    """Jensen-Shannon divergence of distributions `(..., A)`, from 0 for equal to 1 for disjoint ones."""
    apart = entropy_nats((p + q) / 2) - (entropy_nats(p) + entropy_nats(q)) / 2
    return np.asarray(apart / np.log(2))
