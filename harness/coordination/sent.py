"""What voices say to the channel, by what vehicles intend."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from harness.coordination.intents import Intents
from harness.core.arrays import Bools, Ints
from harness.radio.channel import Draws


@dataclass(frozen=True)
class SentIntents:
    """Hold what the ego is sent in n decisions, which under an attack is not what helpers think.

    It comes from H voices, senders as the ego hears them: a helper has one voice; an attacker may
    have several, each with its own message.
    """

    intents: Intents  # the voices' intents and claims, in the place of the helpers'
    draws: Draws  # the channel's random numbers for the link to each voice
    attackers: Bools  # whether each voice is an attacker's, `(n, H)`

    def take(self, at: Any) -> "SentIntents":
        return SentIntents(self.intents.take(at), self.draws.take(at), self.attackers[at])


class Speaker(Protocol):
    """Describe who decides what helpers send during one walk: a run's episodes, step by step.

    What they send is an intent, the probabilities of the ego's actions, and claims of where they
    are. Each condition and walk has its own. The usual one sends the truth, one of attackers does
    not. It may keep state from step to step of an episode.
    """

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        """Return what is sent to the ego in n decisions of one step, given vehicles' true intents.

        `truth` has the intents (probabilities of the ego's actions) and `draws` the channel's
        random numbers for the link to each helper; `episode` and `seed`, `(n,)`, are each
        decision's episode number and seed of these draws. The number of voices, senders as the ego
        hears them, may differ from that of the helpers in `truth`: an attacker may have several.
        """
        ...


class Honest:
    """Send every helper's true answer in one message, as is the case without attackers.

    It is the usual `Speaker`, which decides what helpers send.
    """

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        return SentIntents(truth, draws, np.zeros(truth.valid.shape, dtype=bool))
