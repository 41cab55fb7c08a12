"""Consensus rules that count heads: a claimed distance gives nobody more weight.

Each of them keeps a promise of robustness: where at least two others agree on an action, the ego among them,
no single helper makes it another one. A pool of probabilities alone does not: with each action's median taken
for itself, one voice can make a second choice of all others the first.
"""

from dataclasses import dataclass

import numpy as np

from harness.coordination.consensus import Fused, Messages, Pool, linear_pool
from harness.core.arrays import Bools, Floats, Ints

CLIP = 0.3  # radius of centred clipping, as a distance between distributions (at most sqrt 2)
CLIP_ROUNDS = 5
RELIABILITY = 0.8  # of a helper in the Bayesian pool: the share of messages that say what is the case
NEVER = 1e-9  # what a probability of 0 that the ego gives counts for
WEISZFELD_ROUNDS = 60
SMOOTHING = 1e-6  # keeps Weiszfeld's weights finite where a message is the median itself


@dataclass(frozen=True)
class Heads(Pool):
    """A pool over heads, whose result no single helper flips where all others agree.

    Whoever is heard has the same weight.
    """

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """The pool; where it leaves what all but one want, the mean of those."""
        voices = messages.weights > 0
        heads = np.sum(voices, axis=-1)
        weights = voices / heads[..., None]
        policy = self.pool(messages.intents, weights)
        return Fused(outvoted(policy, messages.intents, voices, np.maximum(heads - 1, 2)), weights, state)


def outvoted(policy: Floats, p: Floats, voices: Bools, votes: Ints) -> Floats:
    """The policy; where so many voices, the ego's among them, want another action, the mean of those.

    Args:
        policy: `(..., A)`.
        p: intents, `(..., 1+H, A)`; those of no voice may hold anything.
        voices: who counts, `(..., 1+H)`.
        votes: how many have to agree, more than half, `(...)`.
    """
    choices = np.where(voices, np.argmax(np.where(voices[..., None], p, -1.0), axis=-1), -1)
    counts = np.sum(choices[..., None] == np.arange(p.shape[-1]), axis=-2)
    wanted = np.argmax(counts, axis=-1)
    agree = choices == wanted[..., None]
    of_those = linear_pool(p, agree / np.maximum(np.sum(agree, axis=-1, keepdims=True), 1))
    stands = (np.max(counts, axis=-1) >= votes) & agree[..., 0] & (np.argmax(policy, axis=-1) != wanted)
    return np.where(stands[..., None], of_those, policy)


def head_trimmed_mean(p: Floats, weights: Floats) -> Floats:
    """Mean of each action's probability less the highest and the lowest head, scaled to sum to 1.

    Of fewer than three heads nothing is trimmed. The k-truncated mean of Guo and Kong (2024) with k = 1.
    """
    voices = weights > 0
    heads = np.sum(voices, axis=-1)[..., None, None]
    rank = np.argsort(
        np.argsort(np.where(voices[..., None], p, np.inf), axis=-2, kind="stable"), axis=-2, kind="stable"
    )
    trimmed = np.where(heads >= 3, 1, 0)
    kept = voices[..., None] & (rank >= trimmed) & (rank < heads - trimmed)
    pooled = np.sum(np.where(kept, p, 0.0), axis=-2)
    total = np.sum(pooled, axis=-1, keepdims=True)
    return np.where(total > 0, pooled / np.where(total > 0, total, 1.0), linear_pool(p, weights))


def geometric_median(p: Floats, weights: Floats) -> Floats:
    """The distribution with the least sum of distances to all messages (Weiszfeld 1937), `(..., A)`."""
    points = np.where((weights > 0)[..., None], p, 0.0)
    middle: Floats = linear_pool(p, weights)
    for _ in range(WEISZFELD_ROUNDS):
        distance = np.linalg.norm(points - middle[..., None, :], axis=-1)
        pull = weights / np.maximum(distance, SMOOTHING)
        middle = linear_pool(points, pull / np.sum(pull, axis=-1, keepdims=True))
    return middle


def centred_clipping(p: Floats, weights: Floats) -> Floats:
    """From the ego's intent, the mean of the steps to all messages, none longer than `CLIP`, `(..., A)`.

    Karimireddy, He and Jaggi (2021), with the ego in place of the last round's aggregate.
    """
    centre = p[..., 0, :]
    for _ in range(CLIP_ROUNDS):
        step = np.where((weights > 0)[..., None], p - centre[..., None, :], 0.0)
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        step *= np.minimum(1.0, CLIP / np.maximum(length, 1e-12))
        centre = centre + np.sum(weights[..., None] * step, axis=-2)
    return np.asarray(centre / np.sum(centre, axis=-1, keepdims=True))


def bayes(p: Floats, weights: Floats, reliability: float | Floats = RELIABILITY) -> Floats:
    """Product of what messages say, each true with a probability and else saying nothing, `(..., A)`.

    A message is worth `r p + (1 - r) / A`, so that no voice counts for more than `(1 - r + A r) / (1 - r)`
    to one. The ego counts as it is. Prior: all actions alike; voices independent, which those of vehicles
    that see the same are not.

    Args:
        p: intents, `(..., 1+H, A)`.
        weights: 0 for who is not heard.
        reliability: of helpers, `(..., H)` or one for all.
    """
    actions = p.shape[-1]
    helper = np.broadcast_to(np.asarray(reliability), weights[..., 1:].shape)
    r = np.concatenate([np.ones(weights[..., :1].shape), helper], axis=-1)[..., None]
    worth = r * np.where((weights > 0)[..., None], p, 1 / actions) + (1 - r) / actions
    logs = np.sum(np.log(np.maximum(worth, NEVER)), axis=-2)
    pooled = np.exp(logs - np.max(logs, axis=-1, keepdims=True))
    return np.asarray(pooled / np.sum(pooled, axis=-1, keepdims=True))


HEADS = {
    "trimmed-heads": Heads(head_trimmed_mean),
    "geometric-median": Heads(geometric_median),
    "centred-clipping": Heads(centred_clipping),
    "bayes": Heads(bayes),
}
