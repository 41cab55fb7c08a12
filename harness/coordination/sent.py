"""What voices say to the channel, by what vehicles intend."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from harness.coordination.intents import Intents
from harness.core.arrays import Bools, Ints
from harness.radio.channel import Draws


@dataclass(frozen=True)
class SentIntents:
    """What H voices say to the channel in decisions (n,)."""

    intents: Intents  # the intents and claims of each voice
    draws: Draws  # the channel's draws for each voice
    attackers: Bools  # which voices are an attacker's, (n, H)

    def take(self, at: Any) -> "SentIntents":
        return SentIntents(self.intents.take(at), self.draws.take(at), self.attackers[at])


class Speaker(Protocol):
    """What is said in a walk under one condition; it may remember."""

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        """Return what is said in decisions (n,), given what the vehicles intend.

        `truth` is what every vehicle intends, of H helpers; `episode` and `seed` are the number and
        the seed of each decision's episode, (n,).
        """
        ...


class Honest:
    """Says what it intends."""

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        return SentIntents(truth, draws, np.zeros(truth.valid.shape, dtype=bool))
