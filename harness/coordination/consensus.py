"""Consensus rules: how intents become one policy. Vehicle 0 is the ego and is always heard.

A rule without memory is one function of (p, weights);
a rule with memory is a class with `start` and `fuse`. `rules.py` lists all rules.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.coordination.claims import Claims
from harness.coordination.plans import Plans
from harness.core.arrays import Bools, Floats, Ints, summed


@dataclass(frozen=True)
class Messages:
    """Hold what a consensus rule fuses: the ego's intent and its helpers' messages.

    An intent is the probabilities that a vehicle gives to the A actions of the ego. Arrays are of
    decisions of any shape `(...)`. On an axis of length 1+H index 0 is the ego and 1+h is helper h;
    on one of length H, index h is helper h.
    """

    # the probabilities that each vehicle gives to the ego's actions, `(..., 1+H, A)`, each row
    # summing to 1; the row of a helper not heard may hold anything
    intents: Floats
    # each vehicle's weight by distance (paper Eq. 2), `(..., 1+H)`, summing to 1; 0 for a helper
    # not heard.
    weights: Floats
    heard: Bools  # whether each helper's reply came within the decision window, `(..., H)`
    # seconds from the start of the decision until each reply came, `(..., H)`; inf if it was lost
    # or not asked for. This is also a message's age, since every vehicle sees the scene at 0.
    arrival_s: Floats
    # each vehicle's distance to the centroid of the conflict zone, m, `(..., 1+H)`; the ego's is
    # what its operating point declares, if it declares one
    distance_m: Floats
    range_m: Floats  # each helper's distance to the ego, m, `(..., H)`
    # what helpers claim of their places and speeds, for a rule whose `needs` names it; else None
    claims: Claims | None = None
    # what agents, vehicles that decide for themselves, say of their own motion, for a rule whose
    # `needs` names it; `intents` are then plans. Else None.
    plans: Plans | None = None
    # number of each helper in its episode, from 0, which it keeps when others leave, `(..., H)`,
    # for a rule whose `needs` names it; -1 for all where helpers have several voices. Else None.
    numbers: Ints | None = None


class Fused(NamedTuple):
    """Hold what a consensus rule returns for decisions `(...)` with H helpers and A actions.

    On the axis of length 1+H index 0 is the ego and 1+h is helper h; on one of length H, index h is
    helper h.
    """

    policy: Floats  # probabilities of the ego's actions after fusion, `(..., A)`
    # each vehicle's weight in the policy, `(..., 1+H)`, the ego first; NaN if the rule has none
    weights: Floats
    # the rule's memory for the next decision of the same episode, `(..., K)`, K numbers of the
    # rule's own; K may be 0
    state: Floats
    # how far the rule trusts each helper that it heard, from 0 to 1, `(..., H)`; below 0.5 it
    # treats the helper as an attacker. NaN for a helper not heard. None if the rule rates no trust.
    trust: Floats | None = None


@runtime_checkable
class Rule(Protocol):
    """Describe a consensus rule: it fuses the action probabilities of the ego and its helpers.

    A rule is a pure function of arrays; its memory is an argument, one row an episode. The steps of
    an episode are fused in order, each from the memory that the last one returned. This includes
    steps in which the ego hears nobody; there it acts on its own intent, its probabilities of the
    actions, whatever the rule returns. The attribute `needs` names optional fields of `Messages`: a
    rule that reads the helpers' claimed places has `("claims",)`. With `("plans",)` it reads what
    each vehicle that decides plans to do itself, and the ego's own intent is then its plan; no
    other rule sees plans. A rule that remembers helpers has `("numbers",)`: where one leaves, the
    places of others move, and their numbers do not.
    """

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """Return the rule's memory before the first decision of each episode, `(*batch, K)`.

        It is K numbers an episode, as many as the rule likes. `batch` is the shape of the episodes
        that are fused together; in each there are `helpers` helpers and `actions` actions.
        """

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Return the policies, weights and next memory of one decision of each episode.

        `messages` has what the ego and its helpers say, with arrays `(...)` of the episodes' shape;
        `state` is the rule's memory of each before this decision, `(..., K)`.
        """


@dataclass(frozen=True)
class Pool:
    """Make a consensus rule without memory of a function that averages probabilities.

    The function, `pool`, takes the intents of the ego and H helpers over A actions,
    `(..., 1+H, A)`, and their weights, `(..., 1+H)`, which sum to 1 and are 0 for a helper not
    heard. It returns policies, `(..., A)`: the probabilities of the ego's actions.
    """

    # takes intents, `(..., 1+H, A)`, and weights, `(..., 1+H)`; returns policies, `(..., A)`
    pool: Callable[[Floats, Floats], Floats]

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """Return the rule's memory before an episode: nothing, as zeros of shape `(*batch, 0)`.

        `batch` is the shape of the episodes that are fused together; the numbers of helpers and
        actions in each do not matter.
        """
        return np.zeros((*batch, 0))

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Return the policies that the function makes of the messages, with the vehicles' weights.

        A policy is the probabilities of the ego's actions. The messages are of one decision of each
        episode; `state`, `(..., 0)`, is the memory of a rule that keeps nothing, and is passed on.
        """
        return Fused(self.pool(messages.intents, messages.weights), messages.weights, state)


def inverse_distance_weights(distance_m: Floats, heard: Bools, min_distance_m: float) -> Floats:
    """Return how much each vehicle counts in fusion by its distance d, `(..., 1+H)`, summing to 1.

    It is Eq. 2 of the paper that this harness follows: weights are 1/d, scaled. It is 0 for a
    helper not heard. If no helper is heard, the ego's weight is exactly 1, so that its own intent
    decides.

    Args:
        distance_m: distance to the centroid of the conflict zone of the ego (index 0) and H
            helpers, m, `(..., 1+H)`.
        heard: which helpers' replies are fused, `(..., H)`.
        min_distance_m: lower bound of a distance, above 0: Eq. 2 has no value at 0 m, and a vehicle
            in the zone would otherwise outvote all others.
    """
    voices = np.insert(heard, 0, True, axis=-1)
    closeness = np.where(voices, 1.0 / np.maximum(distance_m, min_distance_m), 0.0)
    total: Floats = np.sum(closeness, axis=-1, keepdims=True)
    return closeness / total


def capped(weights: Floats, most: float) -> Floats:
    """Return weights in which no helper has more than the share `most` (0 to 1), `(..., 1+H)`.

    `weights`, `(..., 1+H)`, are of the ego (index 0) and H helpers and sum to 1. What a capped
    helper loses goes to the other vehicles in proportion to their weights, so the sum stays 1. The
    ego is never capped and may end above `most`.
    """
    is_capped = np.zeros(weights.shape, dtype=bool)
    scaled = weights
    for _ in range(weights.shape[-1] - 1):
        is_capped[..., 1:] |= scaled[..., 1:] > most
        rest = np.where(is_capped, 0.0, weights)
        total = np.sum(rest, axis=-1, keepdims=True)
        remaining = 1.0 - most * np.sum(is_capped, axis=-1, keepdims=True)
        scaled = np.where(is_capped, most, rest * remaining / np.where(total > 0, total, 1.0))
    return scaled


def linear_pool(p: Floats, weights: Floats) -> Floats:
    """Return the weighted mean of vehicles' intents, `(..., A)`, the linear opinion pool.

    It is Eq. 1 of the paper that this harness follows (Stone 1961).

    Args:
        p: intents, the probabilities that the ego (index 0) and H helpers give to A actions of the
            ego, `(..., 1+H, A)`. Rows of weight 0 may hold anything, NaN included.
        weights: weight of each vehicle, `(..., 1+H)`, summing to 1.
    """
    row_weights = weights[..., None]
    return summed(row_weights * np.where(row_weights > 0, p, 0.0), axis=-2)


def log_pool(p: Floats, weights: Floats, floor: float = 1e-3) -> Floats:
    """Return the weighted geometric mean of intents, scaled to sum to 1, `(..., A)` (Genest 1984).

    `p` are intents, `(..., 1+H, A)`: the probabilities that the ego (index 0) and H helpers give to
    A actions of the ego. `weights`, `(..., 1+H)`, sum to 1 and are 0 for a helper not heard, whose
    row may hold anything. A probability below `floor` counts as `floor`, so that one rounded 0 is
    no veto.
    """
    row_weights = weights[..., None]
    logs = np.log(np.maximum(np.where(row_weights > 0, p, 1.0), floor))
    pooled = np.exp(np.sum(row_weights * logs, axis=-2))
    return np.asarray(pooled / np.sum(pooled, axis=-1, keepdims=True))


def median(p: Floats, weights: Floats) -> Floats:
    """Return the weighted median of each action's probability, scaled to sum to 1, `(..., A)`.

    `p` are intents, `(..., 1+H, A)`: the probabilities that the ego (index 0) and H helpers give to
    A actions of the ego. `weights`, `(..., 1+H)`, sum to 1 and are 0 for a helper not heard, whose
    row may hold anything. If exactly half of the weight lies on either side, it is the mean of the
    two values in the middle. If all medians are 0, as where each vehicle is sure of another action,
    the linear pool (weighted mean) replaces them.
    """
    values, below = _sorted(p, weights)
    low = _pick(values, below >= 0.5 - 1e-12)
    high = _pick(values, below > 0.5 + 1e-12)
    return scaled((low + high) / 2, p, weights)


def trimmed_mean(p: Floats, weights: Floats) -> Floats:
    """Return the weighted trimmed mean of each action's probability, scaled to sum to 1.

    The result is `(..., A)`. `p` are intents, `(..., 1+H, A)`: the probabilities that the ego
    (index 0) and H helpers give to A actions of the ego. `weights`, `(..., 1+H)`, sum to 1 and are
    0 for a helper not heard, whose row may hold anything. The lowest and the highest quarter of the
    weight are left out: more than the linear pool (weighted mean) leaves out, and less than the
    median.
    """
    values, below = _sorted(p, weights)
    inside = np.clip(below, 0.25, 0.75)
    kept = np.diff(inside, axis=-2, prepend=0.25)
    return scaled(np.sum(kept * values, axis=-2) / 0.5, p, weights)


def _sorted(p: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return each action's probabilities in order, `(..., 1+H, A)`,
    and the weight up to and with each.
    """
    # helpers not heard come last, with weight 0
    heard = np.where(weights[..., None] > 0, p, np.inf)
    order = np.argsort(heard, axis=-2, kind="stable")
    below = np.cumsum(
        np.take_along_axis(np.broadcast_to(weights[..., None], p.shape), order, -2), axis=-2
    )
    values = np.take_along_axis(heard, order, -2)
    return np.where(np.isinf(values), 0.0, values), below


def _pick(values: Floats, reached: Bools) -> Floats:
    """Return the first value where `reached`, `(..., A)`."""
    first = np.argmax(reached, axis=-2)[..., None, :]
    return np.take_along_axis(values, first, -2)[..., 0, :]


def scaled(pooled: Floats, p: Floats, weights: Floats) -> Floats:
    """Return fused probabilities of A actions, `(..., A)`, scaled to sum to 1.

    `pooled`, `(..., A)`, are not scaled yet, as medians are not. A row of zeros becomes the linear
    pool: the mean of the intents `p`, `(..., 1+H, A)`, which the ego and H helpers give to these
    actions, by `weights`, `(..., 1+H)`.
    """
    total = np.sum(pooled, axis=-1, keepdims=True)
    return np.where(total > 0, pooled / np.where(total > 0, total, 1.0), linear_pool(p, weights))
