"""The settings `attack` and `defence` of a condition."""

from collections.abc import Collection
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from harness.coordination.contents import INTENTS, WORDS
from harness.coordination.parts import ActsOn, Change, Changes, Part, Text, wrong
from harness.coordination.parts_of_packages import ChangeOfPart
from harness.coordination.robust import outvoted
from harness.coordination.rules import EGO_PROMPT
from harness.coordination.sent import Speaker
from harness.core.arrays import Bools, Floats
from harness.core.errors import unknown
from harness.core.strangers import is_ours, label
from harness.extensions.trust.attacks import (
    ATTACKS,
    Attack,
    Jump,
    Spoof,
    attacks_of,
    in_question,
)
from harness.extensions.trust.changes import MESSAGES, AttackersMessage

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint

MAJORITY = "majority"
DEFENCES = (*MESSAGES, MAJORITY)
# The kinds of message of which each needs some: `schema` leaves nothing of words alone.
DEFENDED = {"quoted": (WORDS,), "schema": (INTENTS,), MAJORITY: (INTENTS,)}
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


def _attacks_on(holds: frozenset[str]) -> list[str]:
    return [name for name in ATTACKS if not holds.isdisjoint(ATTACKS[name].acts_on)]


def _of_claims(attack: Attack) -> bool:
    """Return whether an attack is on who and where helpers are, which a stream says, too."""
    adds_voices = attack.adds and not attack.in_objects
    return adds_voices or isinstance(attack, (Spoof, Jump))


def _defences_on(holds: frozenset[str]) -> list[str]:
    return [name for name in DEFENCES if not holds.isdisjoint(DEFENDED[name])]


class Guard(Part, frozen=True, kw_only=True):
    """Hold a condition's settings `attack` and `defence`, each a text of names; empty is none.

    A condition is an operating point: settings of radio, asking and fusion. `attack` names helpers'
    lies and failures. `defence` names what protects a fusion call, in which the ego's model reads
    the helpers' messages. `behind` is the setting after which both stand in records, `named` has
    what returns the names that there are, and `usual` the values that a sweep takes if none are
    given, joined by commas.
    """

    behind: ClassVar[str] = "fallback"
    named: ClassVar = {"attack": lambda: ATTACKS}
    usual: ClassVar = {"attack": ",".join(("none", *USUAL))}

    # what helpers that lie do, such as `liar:share=1/3+spoof`; empty for none
    attack: Text = ""
    # what guards a fusion call, joined by `+`: `quoted` makes evidence a JSON string; `schema`
    # removes free text from messages; `majority` lets an action on which most voices agree win
    # against the call's; empty for none
    defence: Text = ""

    @property
    def defences(self) -> tuple[str, ...]:
        """Return the names of the defences of a fusion call in this condition, such as `quoted`.

        A condition is a set of settings of radio, asking and fusion. In a fusion call the ego's
        model reads helpers' messages.
        """
        return tuple(part for part in DEFENCES if part in self.defence.split("+"))

    def check(self) -> None:
        attacks_of(self.attack)
        for part in filter(None, self.defence.split("+")):
            if part not in DEFENCES:
                raise unknown("defence", part, DEFENCES)

    @property
    def acts_on(self) -> Collection[ActsOn]:
        acts = []
        for text in filter(None, self.attack.split("+")):
            [attack] = attacks_of(text)
            acts.append(ActsOn("attack", text, attack.acts_on, others=_attacks_on))
        for defence in self.defences:
            acts.append(ActsOn("defence", defence, DEFENDED[defence], others=_defences_on))
        return acts

    def check_with(self, point: "OperatingPoint") -> None:
        if self.attack:
            self._check_attack(point)
        if self.defence and not point.shows_words:
            allowed = f"left out where consensus is not {EGO_PROMPT}"
            raise wrong("defence", self.defence, allowed)

    def _check_attack(self, point: "OperatingPoint") -> None:
        attacks, call = attacks_of(self.attack), point.content.call
        shares = {attack.share for attack in attacks}
        allowed = ""
        in_list = call is not None and call.in_graph
        where = f"where content is {point.ask.content}"
        if point.stream is not None:
            in_list = any(attack.in_objects for attack in attacks)
            where = "where there is a stream"
        if point.radio.profile is None:
            allowed = "left out where there is no channel"
        elif point.stream is not None and any(map(_of_claims, attacks)):
            allowed = f"one of what attackers say, not of who and where they are, {where}"
        elif in_list and len(shares) > 1:
            allowed = f"attacks of one share {where}, as the same vehicles do all"
        elif point.has_fusion_call and not all(attack.by_scene for attack in attacks):
            asks = "consensus" if point.fusion.consensus == EGO_PROMPT else "content"
            where = f"where {asks} is {point.setting(asks)}, which asks the ego twice"
            allowed = f"one that needs no past and adds no voices {where}"
        if allowed:
            raise wrong("attack", self.attack, allowed)

    @property
    def needs(self) -> frozenset[str]:
        return frozenset(
            need for attack in attacks_of(self.attack) for need in getattr(attack, "needs", ())
        )

    @property
    def needs_all(self) -> bool:
        return not all(attack.in_objects for attack in attacks_of(self.attack))

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
            attacks = attacks_of(text)
            change = AttackersMessage(attacks)
            of_packages = [attack for attack in attacks if not is_ours(attack)]
            return ChangeOfPart(label("attack", of_packages[0]), change) if of_packages else change
        return None

    def after_call(self, fused: Floats, intents: Floats, heard: Bools) -> Floats:
        if MAJORITY not in self.defences:
            return fused
        voices = np.insert(heard, 0, True, axis=-1)
        return outvoted(fused, intents, voices, np.sum(voices, axis=-1) // 2 + 1)


def setting_of(attacks: str) -> str:
    """Return the setting under which helpers attack, such as `attack=liar:share=1/3`, as a text.

    It is added to the settings of radio, asking and fusion. `attacks` names the lies:
    `liar:share=1/3+spoof`.
    """
    return f"attack={attacks}"
