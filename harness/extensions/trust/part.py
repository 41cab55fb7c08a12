"""The settings `attack` and `defence` of a condition."""

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from harness.coordination.contents import INTENTS, OBJECTS, PLANS, TRUTH, WORDS
from harness.coordination.parts import Change, Changes, Part, Text, wrong
from harness.coordination.robust import outvoted
from harness.coordination.rules import EGO_PROMPT
from harness.coordination.sent import Speaker
from harness.core.arrays import Bools, Floats
from harness.core.errors import unknown
from harness.extensions.trust.attacks import ATTACKS, Absent, attacks_of, in_question
from harness.extensions.trust.changes import MESSAGES, AttackersMessage

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint

MAJORITY = "majority"
DEFENCES = (*MESSAGES, MAJORITY)
# The usual attacks: each alone, and a false place and several voices with a lie; at a point those
# it allows.
USUAL = (
    "liar",
    "liar+spoof",
    "liar:says=permuted",
    "brake",
    "brake+spoof",
    "random",
    "stuck",
    "stale",
    "replay",
    "silent",
    "overconfident",
    "sybil",
    "liar+sybil",
    "flood",
    "spoof",
    "jump",
    "liar+jump",
    "ghost",
    "hide",
    "shift",
)


class Guard(Part, frozen=True, kw_only=True):
    """What some helpers do instead of saying what they intend, and what guards a fusion call."""

    behind: ClassVar[str] = "rounds"
    named: ClassVar = {"attack": lambda: ATTACKS}
    usual: ClassVar = {"attack": ",".join(("none", *USUAL))}

    # such as `liar:share=1/3+spoof` (`harness.extensions.trust.attacks`); empty for none
    attack: Text = ""
    # Some of `DEFENCES` joined by `+`: `quoted` makes evidence a JSON string; `schema` removes free
    # text from messages; `majority` lets an action on which most voices agree win against the
    # call's.
    defence: Text = ""

    @property
    def defences(self) -> tuple[str, ...]:
        """The defences, in the order of `DEFENCES`."""
        return tuple(part for part in DEFENCES if part in self.defence.split("+"))

    def check(self) -> None:
        attacks_of(self.attack)
        for part in filter(None, self.defence.split("+")):
            if part not in DEFENCES:
                raise unknown("defence", part, DEFENCES)

    def check_with(self, point: "OperatingPoint") -> None:
        if self.attack:
            self._check_attack(point)
        if self.defence:
            self._check_defence(point)

    def _check_attack(self, point: "OperatingPoint") -> None:
        attacks, holds_kinds = attacks_of(self.attack), point.content.holds
        holds = f"where content is {point.ask.content}"
        allowed = ""
        if point.radio.profile is None:
            allowed = "left out where there is no channel"
        elif PLANS in holds_kinds and any(attack.in_words for attack in attacks):
            allowed = f"one on intents {holds}, which has no words"
        elif OBJECTS not in holds_kinds and any(attack.in_objects for attack in attacks):
            allowed = "one on intents where content lists no objects"
        elif holds_kinds & {OBJECTS, TRUTH} and len({attack.share for attack in attacks}) > 1:
            allowed = f"attacks of one share {holds}, as the same vehicles do all"
        elif point.has_fusion_call and not all(attack.by_scene for attack in attacks):
            allowed = "one that needs no past and adds no voices where the ego is asked twice"
        words_alone = holds_kinds == {WORDS}
        kind = "in_words" if words_alone else "in_objects"
        apt = all(getattr(attack, kind) or isinstance(attack, Absent) for attack in attacks)
        if not allowed and not (holds_kinds & {INTENTS, PLANS} or apt):
            able = ", ".join(name for name in ATTACKS if getattr(ATTACKS[name], kind))
            allowed = f"some of {able} and absent {holds}, which holds no intents"
        if allowed:
            raise wrong("attack", self.attack, allowed)

    def _check_defence(self, point: "OperatingPoint") -> None:
        holds = f"where content is {point.ask.content}"
        words_alone = point.content.holds == {WORDS}
        if PLANS in point.content.holds:
            allowed = f"left out {holds}, which is no advice and has no words"
        elif words_alone and self.defence != "quoted":
            allowed = f"quoted or left out {holds}"
        elif point.fusion.consensus != EGO_PROMPT and not words_alone:
            allowed = f"left out where consensus is not {EGO_PROMPT}"
        else:
            return
        raise wrong("defence", self.defence, allowed)

    @property
    def needs(self) -> frozenset[str]:
        return frozenset(
            need for attack in attacks_of(self.attack) for need in getattr(attack, "needs", ())
        )

    @property
    def needs_all(self) -> bool:
        return bool(self.attack)

    def speaker(self) -> Speaker | None:
        from harness.extensions.trust.attackers import Attackers

        return Attackers(attacks_of(self.attack)) if self.attack else None

    def changes(self, words: bool, objects: bool) -> Changes:
        of_all = tuple(name for name in self.defences if name != MAJORITY)
        return Changes(in_question(self.attack, words, objects), of_all)

    @classmethod
    def change(cls, text: str) -> Change | None:
        if text in MESSAGES:
            return MESSAGES[text]
        if text.partition(":")[0] in ATTACKS:
            return AttackersMessage(attacks_of(text))
        return None

    def after_call(self, fused: Floats, intents: Floats, heard: Bools) -> Floats:
        if MAJORITY not in self.defences:
            return fused
        voices = np.insert(heard, 0, True, axis=-1)
        return outvoted(fused, intents, voices, np.sum(voices, axis=-1) // 2 + 1)
