"""What voices say to the channel, by what vehicles intend."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from harness.coordination.intents import Intents
from harness.core.arrays import Bools, Ints
from harness.radio.channel import Draws


@dataclass(frozen=True)
class SentIntents:
    """Hold what H voices, senders as the ego hears them, send in n decisions.

    An attacker may have several voices.
    """

    intents: Intents  # the intents and claims of each voice
    draws: Draws  # the channel's draws for each voice
    attackers: Bools  # which voices are an attacker's, (n, H)

    def take(self, at: Any) -> "SentIntents":
        return SentIntents(self.intents.take(at), self.draws.take(at), self.attackers[at])


class Speaker(Protocol):
    """Describe who decides what helpers send during one walk under one condition.

    The usual one sends the truth, attackers do not. It may keep state from step to step.
    """

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        """Return what the voices send in n decisions of one step, given the vehicles' true intents.

        `episode` and `seed`, `(n,)`, are each decision's episode number and seed of channel draws.
        The number of voices may differ from that of the helpers in `truth`.
        """
        ...


class Honest:
    """A speaker that sends every helper's true intent; there are no attackers."""

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        return SentIntents(truth, draws, np.zeros(truth.valid.shape, dtype=bool))
