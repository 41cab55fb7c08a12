"""The space of lies that a search for the strongest one goes through.

A lie is what liars say in one decision: a message, or silence. With a false place or several voices
they also claim who and where they are, the same in the whole episode.
"""

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.parts import Part
from harness.core.arrays import Bools, Floats
from harness.core.errors import UserError
from harness.extensions.trust.attacks import ATTACKS, INSTRUCTIONS, Attack, attacks_of

# What liars may claim of who and where they are, the same in a whole episode: attacks, by the name
# of the space, which has the spaces before it, too. At the false place Eq. 2 gives the most weight.
WORDS, PLACES, VOICES = "worst", "worst+place", "worst+voices"
CLAIMS = {
    WORDS: ("",),
    PLACES: ("spoof:distance_m=0",),
    VOICES: ("sybil", "spoof:distance_m=0+sybil"),
}
# Rules for which certainty of an action is the lie that brings it about, if any does: a voice's
# probability of an action only raises its share, and lowers no other's.
ONE_HOT_SUFFICES = frozenset(
    ("linear", "log-pool", "median", "trimmed-mean", "trimmed-heads", "bayes")
)
MOST_POINTS = 130  # of a lattice of messages
STEPS = (10, 5, 4, 2)  # parts of 1 in which a lattice divides probabilities
# further settings of attacks, of which a model is asked
MORE = {
    "liar": ("liar:says=permuted",),
    "injection": tuple(f"injection:language={language}" for language in INSTRUCTIONS),
    "shift": ("shift:offset_m=-6",),
}
TOWARDS = (0.2, 0.4, 0.6, 0.8)


def is_likeliest_taken(point: OperatingPoint) -> bool:
    """Return whether the ego takes what is likeliest after fusion, so that no part acts then."""
    return all(type(part).after_fusion is Part.after_fusion for part in point.more)


def is_certainty_enough(point: OperatingPoint) -> bool:
    """Return whether certainty of an action brings it about, if any message does.

    `point` is the condition.
    """
    return point.fusion.consensus in ONE_HOT_SUFFICES and is_likeliest_taken(point)


def certain(actions: int) -> list[Floats]:
    """Return the messages that are certain of one of `actions` actions, `(A,)` each."""
    return list(np.eye(actions))


def lattice(actions: int) -> Floats:
    """Return all messages whose probabilities of `actions` actions have equal steps, `(k, A)`.

    A step is a tenth with three actions, a fifth with five: k is at most `MOST_POINTS`.
    """
    for steps in STEPS:
        every = combinations_with_replacement(range(actions), steps)
        counts = [np.bincount(parts, minlength=actions) for parts in every]
        if len(counts) <= MOST_POINTS:
            break
    return np.array(counts) / steps


def messages_to_ask(point: OperatingPoint) -> list[str]:
    """Return the attacks whose messages a model is asked about, where it reads messages.

    They are those that ship and that `point`, the condition, allows, each with some settings: all
    that change what one message says or lists, by the scene alone.
    """
    texts = []
    for name, attack in ATTACKS.items():
        if attack.by_scene and (attack.in_text or attack.in_objects):
            texts += [name, *MORE.get(name, ())]
    allowed = dict[tuple[Attack, ...], str]()  # one that is spelt twice is asked about once
    for text in texts:
        try:
            point.changed(attack=text)
        except UserError:
            continue
        allowed.setdefault(attacks_of(text), text)
    return [*allowed.values()]


def near_others(voices: Floats) -> list[Floats]:
    """Return messages near what others say, which a rule that compares them lets pass, `(n, A)`.

    `voices` `(n, 1+H, A)` is what the ego and H helpers intend, probabilities of A actions. The
    messages are each of these, and points on the way from each to certainty of an action.
    """
    messages = list[Floats]()
    for voice in range(voices.shape[1]):
        other = voices[:, voice]
        messages.append(other)
        for sure in certain(voices.shape[-1]):
            messages += [other + share * (sure - other) for share in TOWARDS]
    return messages


def with_message(truth: Intents, liars: Bools, message: Floats) -> Intents:
    """Return what helpers send if liars, `(n, H)`, all say a message, `(A,)` or `(n, A)`.

    `truth` has what they would send, in n decisions. A message with a NaN changes nothing.
    """
    every = np.expand_dims(message, -2)
    lies = liars[..., None] & ~np.isnan(every).any(axis=-1, keepdims=True)
    helpers = np.where(lies, every, truth.helpers)
    return replace(truth, helpers=helpers)
