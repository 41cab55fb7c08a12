"""Consensus rules that count heads, so that a claimed distance gives no helper more weight.

Each of them makes the same promise: if at least two others, the ego among them, agree on an action,
no single helper can change it. A pool of probabilities alone does not keep it: if each action's
median is taken by itself, one voice can make the second choice of all others the first.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from harness.coordination.consensus import Fused, Messages, Pool, linear_pool, scaled
from harness.core.arrays import Bools, Floats, Ints, length_of, summed

CLIP = 0.3  # radius of centred clipping, as a distance between distributions (at most sqrt 2)
CLIP_ROUNDS = 5
RELIABILITY = 0.8  # share of a helper's messages that are true, in the Bayesian pool
NEVER = 1e-9  # what a probability of 0 of the ego counts as
WEISZFELD_ROUNDS = 60
SMOOTHING = 1e-6  # keeps Weiszfeld's weights finite if a message is the median itself


@dataclass(frozen=True)
class Heads(Pool):
    """Make a consensus rule that weighs all vehicles alike, and that no helper can turn alone.

    It is made of a function `pool` from intents `(..., 1+H, A)` and weights `(..., 1+H)` to
    policies `(..., A)`. If all vehicles but at most one, the ego among them, have the same
    likeliest action and the policy has another, the mean intent of these vehicles replaces it.
    `by_distance` is false: claimed distances weigh nothing.
    """

    # whether claimed distances weigh; read by the checks of an operating point
    by_distance: ClassVar[bool] = False

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Return the fused probabilities, in which no single helper can turn the decision.

        They are the pool of all vehicles heard, with equal weights; or, where the pool's likeliest
        action is another than that of a majority, the majority's mean intent. A majority is all but
        at most one of the vehicles heard, the ego among them, at least two. `messages` are of one
        decision of each episode; `state`, the memory of a rule that keeps nothing, is passed on
        unchanged.
        """
        voices = messages.weights > 0
        heads = np.sum(voices, axis=-1)
        weights = voices / heads[..., None]
        policy = self.pool(messages.intents, weights)
        return Fused(
            outvoted(policy, messages.intents, voices, np.maximum(heads - 1, 2)), weights, state
        )


def outvoted(policy: Floats, p: Floats, voices: Bools, votes: Ints) -> Floats:
    """Return policies, replaced where a majority of vehicles wants another action, `(..., A)`.

    So no single liar turns a decision. The replacement is the mean intent of the vehicles in the
    majority, which counts only if the ego is in it. An intent is the probabilities that a vehicle
    gives to the ego's actions; it votes for the likeliest.

    Args:
        policy: the fused probabilities of A actions to check, `(..., A)`.
        p: intents of the ego (index 0) and H helpers, `(..., 1+H, A)`; the row of a vehicle that
            has no voice may hold anything.
        voices: which vehicles count, `(..., 1+H)`.
        votes: how many make a majority, more than half, `(...)`.
    """
    choices = np.where(voices, np.argmax(np.where(voices[..., None], p, -1.0), axis=-1), -1)
    counts = np.sum(choices[..., None] == np.arange(p.shape[-1]), axis=-2)
    majority_action = np.argmax(counts, axis=-1)
    in_majority = choices == majority_action[..., None]
    majority_mean = linear_pool(
        p, in_majority / np.maximum(np.sum(in_majority, axis=-1, keepdims=True), 1)
    )
    overrides = (
        (np.max(counts, axis=-1) >= votes)
        & in_majority[..., 0]
        & (np.argmax(policy, axis=-1) != majority_action)
    )
    return np.where(overrides[..., None], majority_mean, policy)


def head_trimmed_mean(p: Floats, weights: Floats) -> Floats:
    """Return each action's mean probability without its lowest and highest voice, `(..., A)`.

    It is scaled to sum to 1 (k-truncated mean with k = 1, Guo and Kong 2024). With fewer than three
    voices, none is left out. `p` are intents, the probabilities that the ego (index 0) and H
    helpers give to A actions, `(..., 1+H, A)`; of `weights`, `(..., 1+H)`, only whether they are
    above 0 counts, which marks the voices heard.
    """
    voices = weights > 0
    heads = np.sum(voices, axis=-1)[..., None, None]
    rank = np.argsort(
        np.argsort(np.where(voices[..., None], p, np.inf), axis=-2, kind="stable"),
        axis=-2,
        kind="stable",
    )
    trimmed = np.where(heads >= 3, 1, 0)
    kept = voices[..., None] & (rank >= trimmed) & (rank < heads - trimmed)
    return scaled(np.sum(np.where(kept, p, 0.0), axis=-2), p, weights)


def geometric_median(p: Floats, weights: Floats) -> Floats:
    """Return the distribution with the least weighted sum of L2 distances to intents, `(..., A)`.

    Computed by Weiszfeld's iteration (1937). `p` are intents, the probabilities that the ego (index
    0) and H helpers give to A actions, `(..., 1+H, A)`; `weights`, `(..., 1+H)`, are 0 for a helper
    not heard.
    """
    points = np.where((weights > 0)[..., None], p, 0.0)
    middle: Floats = linear_pool(p, weights)
    for _ in range(WEISZFELD_ROUNDS):
        away = points - middle[..., None, :]
        distance = np.sqrt(summed(away * away, -1))
        pull = weights / np.maximum(distance, SMOOTHING)
        middle = linear_pool(points, pull / np.sum(pull, axis=-1, keepdims=True))
    return middle


def centred_clipping(p: Floats, weights: Floats) -> Floats:
    """Return the ego's intent, moved `CLIP_ROUNDS` times by the weighted mean of clipped steps.

    A step leads to another vehicle's intent and is at most `CLIP` long (L2); the result is
    `(..., A)`. From Karimireddy, He and Jaggi (2021), but starting from the ego's intent. `p` are
    intents, the probabilities that the ego (index 0) and H helpers give to A actions,
    `(..., 1+H, A)`; `weights`, `(..., 1+H)`, sum to 1 and are 0 for a helper not heard.
    """
    centre = p[..., 0, :]
    for _ in range(CLIP_ROUNDS):
        step = np.where((weights > 0)[..., None], p - centre[..., None, :], 0.0)
        length = length_of(step)[..., None]
        step *= np.minimum(1.0, CLIP / np.maximum(length, 1e-12))
        centre = centre + summed(weights[..., None] * step, axis=-2)
    return np.asarray(centre / np.sum(centre, axis=-1, keepdims=True))


def bayes(p: Floats, weights: Floats, reliability: float | Floats = RELIABILITY) -> Floats:
    """Return the posterior of the best action by all intents as independent evidence, `(..., A)`.

    Each helper is right with probability r (`reliability`) and else uninformative, so its intent
    counts as `r p + (1 - r) / A`; the ego's counts as it is, and the prior is uniform. Vehicles
    that see the same are not independent, which this ignores.

    Args:
        p: intents, the probabilities that the ego (index 0) and H helpers give to A actions,
            `(..., 1+H, A)`.
        weights: 0 for a helper not heard, `(..., 1+H)`; nothing else of them counts.
        reliability: reliability of the helpers, from 0 to 1, `(..., H)` or one for all.
    """
    actions = p.shape[-1]
    helper_r = np.broadcast_to(np.asarray(reliability), weights[..., 1:].shape)
    r = np.concatenate([np.ones(weights[..., :1].shape), helper_r], axis=-1)[..., None]
    evidence = r * np.where((weights > 0)[..., None], p, 1 / actions) + (1 - r) / actions
    logs = np.sum(np.log(np.maximum(evidence, NEVER)), axis=-2)
    pooled = np.exp(logs - np.max(logs, axis=-1, keepdims=True))
    return np.asarray(pooled / np.sum(pooled, axis=-1, keepdims=True))


HEADS = {
    "trimmed-heads": Heads(head_trimmed_mean),
    "geometric-median": Heads(geometric_median),
    "centred-clipping": Heads(centred_clipping),
    "bayes": Heads(bayes),
}
