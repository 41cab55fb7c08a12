"""Compare what agents do with the plans that they sent."""

from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.evaluate.walk import Decided


def broken_words(decided: Decided[Any]) -> Floats:
    """Return for n agents' decisions whether each contradicts the plan that the agent sent, `(n,)`.

    An agent is a vehicle that decides for itself, and a plan what it says it will do. `decided` has
    the decisions and what was sent. It is 1 if the action taken is not the likeliest of the plan
    that some receiver last got, else 0; NaN for an agent whose plan nobody received.
    """
    broken, intents = np.full(len(decided.due.at), np.nan), decided.said.intents
    if decided.due.senders is None or intents.plans is None:
        return broken
    senders = intents.plans.row
    got = decided.result.delivered & (senders >= 0)
    who, word = senders[got], np.argmax(intents.helpers[got], axis=-1)
    np.fmax.at(broken, who, decided.result.action[who] != word)
    return broken
