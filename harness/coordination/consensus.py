"""How intents become one policy. Vehicle 0 is the ego and is always heard.

A rule without memory is one function of (p, weights); a rule with memory is a class with `start` and `fuse`.
`rules.py` lists them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.coordination.claims import Claims
from harness.core.arrays import Bools, Floats, summed


@dataclass(frozen=True)
class Messages:
    """What an ego has to fuse. A message's sender is its place: 0 is the ego, 1+h is helper h.

    Attributes:
        intents: what each vehicle intends, `(..., 1+H, A)`; a row that is not heard may hold anything.
        weights: paper Eq. 2, `(..., 1+H)`, summing to 1; 0 for a helper not heard.
        heard: which replies came in time, `(..., H)`.
        arrival_s: when, from the start of the decision, `(..., H)`: the message's age, for every vehicle saw
            the scene at 0. inf where lost or not asked.
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`; the ego's is what its
            operating point declares, if it does.
        range_m: distance to the ego, `(..., H)`.
        claims: what helpers say of themselves, for a rule whose `needs` names it; None where nobody looked.
    """

    intents: Floats
    weights: Floats
    heard: Bools
    arrival_s: Floats
    distance_m: Floats
    range_m: Floats
    claims: Claims | None = None


class Fused(NamedTuple):
    """What a rule makes of messages.

    Attributes:
        policy: `(..., A)`, each a distribution.
        weights: each vehicle's weight in it, `(..., 1+H)`; NaN where there is no such thing.
        state: what the rule remembers at the next step, `(..., K)`; K may be 0.
        trust: how far the rule trusts each helper that it heard, from 0 to 1, `(..., H)`; below 0.5 it takes
            it for an attacker. NaN where it heard nothing. None of a rule that judges nobody.
    """

    policy: Floats
    weights: Floats
    state: Floats
    trust: Floats | None = None


@runtime_checkable
class Rule(Protocol):
    """A pure function of arrays, with a memory of its own for each episode.

    Steps of an episode are fused in order, each from the state that the last one left, those in which the ego
    hears nobody as well. In those it acts on its own intent, whatever the rule says. A rule that looks at
    `Messages.claims` has `needs = ("claims",)`.
    """

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """What the rule remembers before the first step of episodes `batch`, `(*batch, K)`."""

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """The policy of one step of each episode."""


@dataclass(frozen=True)
class Pool:
    """The rule that remembers nothing: what was heard goes through a function of (p, weights)."""

    pool: Callable[[Floats, Floats], Floats]

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """Nothing."""
        return np.zeros((*batch, 0))

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Whatever the state."""
        return Fused(self.pool(messages.intents, messages.weights), messages.weights, state)


def inverse_distance_weights(distance_m: Floats, heard: Bools, min_distance_m: float) -> Floats:
    """Weight of each vehicle, `(..., 1+H)`, summing to 1 (paper Eq. 2); 0 for a helper not heard.

    With no helper heard the ego's weight is exactly 1, which is the paper's fall-back to its own intent.

    Args:
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`.
        heard: which helpers' replies are fused, `(..., H)`.
        min_distance_m: lower bound of a distance, above 0: Eq. 2 has no value at 0 m, and a vehicle
            in the zone would otherwise outvote everybody.
    """
    fused = np.insert(heard, 0, True, axis=-1)
    closeness = np.where(fused, 1.0 / np.maximum(distance_m, min_distance_m), 0.0)
    total: Floats = np.sum(closeness, axis=-1, keepdims=True)
    return closeness / total


def capped(weights: Floats, most: float) -> Floats:
    """The weights `(..., 1+H)` with no helper's above `most`; all others share what it loses.

    The ego's may grow beyond it. Weights that sum to 1 still do.
    """
    fixed = np.zeros(weights.shape, dtype=bool)
    scaled = weights
    for _ in range(weights.shape[-1] - 1):
        fixed[..., 1:] |= scaled[..., 1:] > most
        rest = np.where(fixed, 0.0, weights)
        total = np.sum(rest, axis=-1, keepdims=True)
        left = 1.0 - most * np.sum(fixed, axis=-1, keepdims=True)
        scaled = np.where(fixed, most, rest * left / np.where(total > 0, total, 1.0))
    return scaled


def linear_pool(p: Floats, weights: Floats) -> Floats:
    """Weighted mean of intents, `(..., A)` (paper Eq. 1; the linear opinion pool of Stone 1961).

    Args:
        p: intents, `(..., 1+H, A)`. Rows of weight 0 may hold anything, NaN included.
        weights: weight of each vehicle, `(..., 1+H)`, summing to 1.
    """
    row_weights = weights[..., None]
    return summed(row_weights * np.where(row_weights > 0, p, 0.0), axis=-2)


def log_pool(p: Floats, weights: Floats, floor: float = 1e-3) -> Floats:
    """Weighted geometric mean of intents, `(..., A)` (the logarithmic opinion pool of Genest 1984).

    A probability below `floor` counts as that much, so that one rounded 0 is no veto.
    """
    row_weights = weights[..., None]
    logs = np.log(np.maximum(np.where(row_weights > 0, p, 1.0), floor))
    pooled = np.exp(np.sum(row_weights * logs, axis=-2))
    return np.asarray(pooled / np.sum(pooled, axis=-1, keepdims=True))


def median(p: Floats, weights: Floats) -> Floats:
    """Weighted median of each action's probability, scaled to sum to 1, `(..., A)`.

    Where half of the weight lies exactly on either side, the mean of the two in the middle. All medians can
    be 0, if every vehicle is sure of another action than the others; then the linear pool stands in.
    """
    values, below = _sorted(p, weights)
    low = _pick(values, below >= 0.5 - 1e-12)
    high = _pick(values, below > 0.5 + 1e-12)
    return _scaled((low + high) / 2, p, weights)


def trimmed_mean(p: Floats, weights: Floats) -> Floats:
    """Weighted mean of each action's probability less the lowest and highest quarter of weight, `(..., A)`.

    Scaled to sum to 1. Between the median, which trims all, and the linear pool, which trims nothing.
    """
    values, below = _sorted(p, weights)
    inside = np.clip(below, 0.25, 0.75)
    kept = np.diff(inside, axis=-2, prepend=0.25)
    return _scaled(np.sum(kept * values, axis=-2) / 0.5, p, weights)


def _sorted(p: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Each action's probabilities in order, `(..., 1+H, A)`, and the weight up to and with each."""
    heard = np.where(weights[..., None] > 0, p, np.inf)  # who is not heard comes last, with weight 0
    order = np.argsort(heard, axis=-2, kind="stable")
    below = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], p.shape), order, -2), axis=-2)
    values = np.take_along_axis(heard, order, -2)
    return np.where(np.isinf(values), 0.0, values), below


def _pick(values: Floats, reached: Bools) -> Floats:
    """The first value where `reached`, `(..., A)`."""
    first = np.argmax(reached, axis=-2)[..., None, :]
    return np.take_along_axis(values, first, -2)[..., 0, :]


def _scaled(pooled: Floats, p: Floats, weights: Floats) -> Floats:
    total = np.sum(pooled, axis=-1, keepdims=True)
    return np.where(total > 0, pooled / np.where(total > 0, total, 1.0), linear_pool(p, weights))
