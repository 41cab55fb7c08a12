"""Compare what agents do with the plans that they sent."""

from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.evaluate.walk import Decided


def broken_words(decided: Decided[Any]) -> Floats:
    """Return whether each agent breaks its word, (n,):
    its action is not the likeliest of the plan it sent.

    It breaks its word if that holds for anybody who got a plan,
    of the last that this one fused. NaN for an agent whose plan nobody got.
    """
    broken, intents = np.full(len(decided.due.at), np.nan), decided.said.intents
    if decided.due.senders is None or intents.plans is None:
        return broken
    senders = intents.plans.row
    got = decided.result.delivered & (senders >= 0)
    who, word = senders[got], np.argmax(intents.helpers[got], axis=-1)
    np.fmax.at(broken, who, decided.result.action[who] != word)
    return broken
