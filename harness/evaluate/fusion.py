"""Fusion calls: the ego's model answers with the messages that arrived beside its own view.

Who is heard depends on the channel and not on fusion, so the sets of messages that any condition and seed
hears are known before the first call. There is one call for each set.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.coordination.attacks import Turn, attacks_of
from harness.coordination.intents import Intents
from harness.coordination.operating_point import Rewrites
from harness.core.arrays import Bools, Floats, Ints
from harness.evaluate.repair import as_text
from harness.runs.records import BLIND, REWRITTEN, Answer


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

    def at(self, moments: Ints, attackers: Bools | None = None) -> "FusionAnswersAt":
        """The fusion call of decisions at these moments, (n,); with attackers in the text, (n, H)."""
        return FusionAnswersAt(self, moments, attackers)


@dataclass(frozen=True)
class FusionAnswersAt:
    """A fusion call for decisions at some moments, as `coordinate` wants it."""

    answers: FusionAnswers
    moments: Ints
    attackers: Bools | None = None

    def __call__(self, on_time: Bools) -> tuple[Floats, Floats]:
        """Intents (n, A) and seconds (n,) for who was heard, (n, H); NaN where nobody was."""
        answers, anybody = self.answers, on_time.any(axis=1)
        wanted = codes_of(on_time, self.moments, self.attackers)[anybody]
        intents = np.full((len(on_time), answers.intents.shape[1]), np.nan)
        seconds = np.full(len(on_time), np.nan)
        if len(wanted):
            place = np.minimum(np.searchsorted(answers.codes, wanted), len(answers.codes) - 1)
            if not len(answers.codes) or not np.array_equal(answers.codes[place], wanted):
                raise LookupError("the ego's model was never asked about a set of messages that was heard")
            intents[anybody], seconds[anybody] = answers.intents[place], answers.seconds[place]
        return intents, seconds


def codes_of(on_time: Bools, moments: Ints, attackers: Bools | None = None) -> Ints:
    """One number for a moment and who was heard in it, (n,), from (n, H) and moments (n,).

    With attackers (n, H) also for which of those attack.
    """
    said = on_time if attackers is None else np.concatenate([on_time, on_time & attackers], axis=1)
    return np.asarray(moments << said.shape[1] | said @ (1 << np.arange(said.shape[1])))


def heard_in(code: int, helpers: int, attacked: bool = False) -> tuple[int, list[int], list[int]]:
    """The moment of a code, the helpers that were heard, counted from 0, and those of them that attack."""
    bits = helpers * (1 + attacked)
    heard = [h for h in range(helpers) if code >> h & 1]
    return code >> bits, heard, [h for h in heard if attacked and code >> (helpers + h) & 1]


def key_of(helper: str, rewrites: Rewrites, attacks: bool) -> str:
    """Names what a helper says in a fusion call: `v2`, `v2~blind`, `v3!liar&schema`."""
    changed = [*([rewrites.attack] if attacks and rewrites.attack else []), *rewrites.defences]
    return helper + BLIND * rewrites.blind + (REWRITTEN + "&".join(changed) if changed else "")


def messages_of(
    answers: Mapping[str, Answer], senders: Sequence[str], actions: Sequence[str]
) -> list[dict[str, Any]]:
    """What these helpers sent, as a prompt takes it, from the answers of a moment by key."""
    found = []
    for sender in senders:
        key, _, changes = sender.partition(REWRITTEN)
        if (said := answers.get(key)) and said.intent and said.message:
            message = {"intent": list(said.intent), **said.message}
            for change in filter(None, changes.split("&")):
                message = _rewritten(message, change, actions)
            message["evidence"] = as_text(message["evidence"])  # no token of a chat template gets through
            found.append({"sender": key.removesuffix(BLIND), **message})
    return found


def _rewritten(message: dict[str, Any], change: str, actions: Sequence[str]) -> dict[str, Any]:
    """A message as an attack or a defence leaves it."""
    if change == "schema":
        return {**message, "evidence": ""}
    if change == "quoted":
        return {**message, "evidence": json.dumps(message["evidence"], ensure_ascii=False)}
    [attack] = attacks_of(change)
    p = np.array([[message["intent"]]])
    alone = Intents(
        np.full((1, p.shape[-1]), np.nan), p, np.ones((1, 1), dtype=bool), np.zeros((1, 2)), np.zeros((1, 1)),
        np.zeros((1, 1)), np.zeros((1, 2)),
    )  # fmt: skip
    turn = Turn(alone, np.ones((1, 1), dtype=bool), p, np.empty((1, 0, *p.shape[1:])), np.zeros((1, 1)))
    intent = attack.act(alone, turn).helpers[0, 0].tolist()
    return {**attack.rewritten(message, actions), "intent": intent}
