"""Rules that read plans: who goes first is decided by an order that all agents know,
and the others wait.

A rule knows what agents say of themselves (`plans.Plans`) and the actions that they plan. It is not
told whether two ways cross, and nobody pays for going first.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from harness.coordination.consensus import Fused, Messages
from harness.coordination.plans import Plans
from harness.core.arrays import Floats


@dataclass(frozen=True)
class Precedence:
    """Decide who waits: an agent waits for a near one of lower rank that plans to go on.

    An agent is a vehicle that decides for itself, and this is a consensus rule: it makes an agent's
    policy of its own plan and of those that others sent. To wait is to take action 0, the most
    careful one; else the agent acts by its own probabilities of actions. Two are near if they reach
    the conflict (where paths meet) less than `apart_s` seconds apart. An agent that itself plans
    action 0, stands, or has passed the conflict makes nobody wait. Equal ranks go by the vehicles'
    numbers in the world. `needs` says that the rule reads plans, `by_distance` that distances weigh
    nothing.
    """

    # returns the rank of the agent and of its H helpers, `(..., 1+H)`; the lowest goes first
    rank: Callable[[Plans], Floats]
    # two agents are near if they reach the conflict at times less than this apart. Declared: the
    # headway of the two-second rule
    apart_s: float = 2.0
    needs: ClassVar[tuple[str, ...]] = ("plans",)
    by_distance: ClassVar[bool] = False

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Floats:
        """Return the memory of a rule that keeps nothing: zeros of shape `(*batch, 0)`.

        The rule fuses messages and remembers none. `batch` is the shape of the decisions, and
        `helpers` and `actions` are numbers of them, not read.
        """
        return np.zeros((*batch, 0))

    def fuse(self, messages: Messages, state: Floats) -> Fused:
        """Return each agent's policy: its own intent, or certainty of action 0 where it waits.

        An intent is probabilities of A actions. `messages` has those of the agent (a vehicle that
        decides) and of H helpers, `(..., 1+H, A)`, whom it heard, and their plans. Weights of
        helpers are NaN; `state`, the rule's memory, is returned as it is. Raises ValueError if
        `messages.plans` is None.
        """
        if (plans := messages.plans) is None:
            raise ValueError("a rule that reads plans needs them")
        p, rank = messages.intents, self.rank(plans)
        mine, others = rank[..., :1], rank[..., 1:]
        ties = (others == mine) & (plans.vehicle[..., 1:] < plans.vehicle[..., :1])
        reaches_s = np.where(np.isinf(plans.reaches_s), np.nan, plans.reaches_s)
        near = np.abs(reaches_s[..., 1:] - reaches_s[..., :1]) < self.apart_s
        goes = np.argmax(p[..., 1:, :], axis=-1) > 0
        waits = np.any(messages.heard & near & goes & ((others < mine) | ties), axis=-1)
        careful = np.eye(p.shape[-1])[0]
        policy = np.where(waits[..., None], careful, p[..., 0, :])
        return Fused(policy, np.full(messages.weights.shape, np.nan), state)


def _by_time(plans: Plans) -> Floats:
    return plans.reaches_s


def _by_number(plans: Plans) -> Floats:
    return plans.vehicle.astype(float)


def _by_bid(plans: Plans) -> Floats:
    return -plans.lost_s


BY_TIME = Precedence(_by_time)  # who reaches the conflict sooner goes on
BY_NUMBER = Precedence(_by_number)
BY_BID = Precedence(_by_bid)  # each bids the time that it has lost; the highest bid goes on
