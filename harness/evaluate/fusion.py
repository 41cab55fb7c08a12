"""Fusion calls: the ego's model answers with the messages that arrived beside its own view.

Who is heard depends on the channel and not on fusion, so the sets of messages that any condition and seed
hears are known before the first call. There is one call for each set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.runs.records import BLIND, Answer


@dataclass(frozen=True)
class FusionAnswers:
    """The ego's answers to K sets of messages; H helpers, A actions.

    Attributes:
        codes: moment and who was heard in it (`codes_of`), ascending, (K,).
        intents: (K, A); NaN where the answer failed.
        seconds: time of each fusion call, (K,).
    """

    codes: Ints
    intents: Floats
    seconds: Floats

    def at(self, moments: Ints) -> "FusionAnswersAt":
        """The fusion call of decisions at these moments, (n,)."""
        return FusionAnswersAt(self, moments)


@dataclass(frozen=True)
class FusionAnswersAt:
    """A fusion call for decisions at some moments, as `coordinate` wants it."""

    answers: FusionAnswers
    moments: Ints

    def __call__(self, on_time: Bools) -> tuple[Floats, Floats]:
        """Intents (n, A) and seconds (n,) for who was heard, (n, H); NaN where nobody was."""
        answers, anybody = self.answers, on_time.any(axis=1)
        wanted = codes_of(on_time, self.moments)[anybody]
        intents = np.full((len(on_time), answers.intents.shape[1]), np.nan)
        seconds = np.full(len(on_time), np.nan)
        if len(wanted):
            place = np.minimum(np.searchsorted(answers.codes, wanted), len(answers.codes) - 1)
            if not len(answers.codes) or not np.array_equal(answers.codes[place], wanted):
                raise LookupError("the ego's model was never asked about a set of messages that was heard")
            intents[anybody], seconds[anybody] = answers.intents[place], answers.seconds[place]
        return intents, seconds


def codes_of(on_time: Bools, moments: Ints) -> Ints:
    """One number for a moment and who was heard in it, (n,), from (n, H) and moments (n,)."""
    helpers = on_time.shape[1]
    return np.asarray(moments << helpers | on_time @ (1 << np.arange(helpers)))


def heard_in(code: int, helpers: int) -> tuple[int, list[int]]:
    """The moment of a code, and the helpers that were heard, counted from 0."""
    return code >> helpers, [h for h in range(helpers) if code >> h & 1]


def messages_of(answers: Mapping[str, Answer], senders: Sequence[str]) -> list[dict[str, Any]]:
    """What these helpers sent, as a prompt takes it, from the answers of a moment by key."""
    return [
        {"sender": sender.removesuffix(BLIND), "intent": list(said.intent), **said.message}
        for sender in senders
        if (said := answers.get(sender)) and said.intent and said.message
    ]
