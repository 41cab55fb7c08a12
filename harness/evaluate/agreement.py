"""Compare what agents do with the plans that they sent."""

from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.evaluate.walk import Decided


def broken_words(decided: Decided[Any]) -> Floats:
    """Return whether each agent breaks its word, (n,): its action is not the likeliest of the plan it sent.

    It counts as sent if anybody got it, as it was sent last. NaN for an agent whose plan nobody got.
    """
    broken = np.full(len(decided.due.at), np.nan)
    if (senders := decided.due.senders) is None:
        return broken
    intents, delivered = decided.said.intents, decided.result.delivered
    if intents.voice_of is not None:  # an attacker with several voices
        senders = np.take_along_axis(senders, intents.voice_of, axis=-1)
    got = delivered & (senders >= 0)
    who, word = senders[got], np.argmax(intents.helpers[got], axis=-1)
    # all who got its plan got the same, and an attacker with several voices is judged by the last
    broken[who] = decided.result.action[who] != word
    return broken
