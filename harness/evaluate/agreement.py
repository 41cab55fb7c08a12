"""Compare what agents do with the plans that they sent."""

from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.evaluate.walk import Decided


def broken_words(decided: Decided[Any]) -> Floats:
    """Return for n decisions whether each contradicts the plan that its vehicle had sent, `(n,)`.

    It is for scenarios in which several vehicles decide for themselves, and tell each other what
    they will do. `decided` has the decisions and what was sent. The value is 1 if the action taken
    is not the likeliest of the plan that some receiver last got, else 0; NaN where nobody received
    a plan.
    """
    broken, intents = np.full(len(decided.due.at), np.nan), decided.said.intents
    if decided.due.senders is None or intents.plans is None:
        return broken
    senders = intents.plans.row
    got = decided.result.delivered & (senders >= 0)
    who, word = senders[got], np.argmax(intents.helpers[got], axis=-1)
    np.fmax.at(broken, who, decided.result.action[who] != word)
    return broken
