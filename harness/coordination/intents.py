"""Define `Intents`: what vehicles intend in a set of decisions,
and what else coordination needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from harness.coordination.claims import Claims
from harness.coordination.plans import Plans
from harness.coordination.scheduling import Outlook
from harness.core.arrays import Bools, Floats, Ints, taken
from harness.radio.channel import Site


@dataclass(frozen=True)
class Intents:
    """Hold what vehicles intend in decisions, and what else coordination needs to play these.

    An intent is the probabilities that a vehicle gives to the ego's A actions: what the ego should
    do, as that vehicle sees it. The conflict zone is where their paths and the ego's meet. Arrays
    are of decisions of any shape `(...)`. On an axis of length 1+H index 0 is the ego and 1+h is
    helper h; on one of length H, index h is helper h.
    """

    own: Floats  # the ego's intent, `(..., A)`; a row with a NaN is a failed answer
    helpers: Floats  # each helper's intent, `(..., H, A)`
    # whether the helper exists and its answer parsed, `(..., H)`; any other helper sends nothing,
    # takes no slot on air, and may hold NaN in every array
    valid: Bools
    # each vehicle's distance to the centroid of the conflict zone, m, `(..., 1+H)`, the ego first;
    # that of a helper is as the ego knows it, from beacons
    distance_m: Floats
    range_m: Floats  # each helper's distance to the ego, m, `(..., H)`, as the ego knows it
    payload_bits: Floats  # size of each helper's reply, bits, `(..., H)`
    # seconds that each vehicle's model takes to answer, `(..., 1+H)`, the ego first; NaN where
    # unknown
    inference_s: Floats
    # where the vehicles truly are and what stands between them, if the channel needs it; else None
    site: Site | None = None
    # whether the helper, if asked, sends nothing in its slot, `(..., H)`. None if no helper is.
    silent: Bools | None = None
    # index from 0 of the helper that is behind each of the H voices, `(..., H)`: an attacker may
    # send as several. None if each helper has one voice.
    voice_of: Ints | None = None
    # how much the ego sees of where a danger may come from, and what helpers would add, if a
    # schedule needs it; else None
    outlook: Outlook | None = None
    # what helpers claim of their places and speeds, if a rule or an attack needs it; else None
    claims: Claims | None = None
    # bytes of each reply's text, `(..., H)`; None if replies have none
    text_bytes: Floats | None = None
    # how many objects each helper lists, `(..., H)`, if messages hold objects; else None
    objects: Floats | None = None
    # size of these lists as compact JSON, bits, `(..., H)`; None if messages hold none
    object_bits: Floats | None = None
    # whether the helper's model was not asked yet, `(..., H)`; until then it counts as valid. None
    # if the models of all were.
    unasked: Bools | None = None
    # what agents, the vehicles that decide for themselves, say of their own motion, if messages
    # hold plans; of the ego of each decision alone, `(..., 1)`, until it is known whom it hears.
    # Else None.
    plans: Plans | None = None
    # size of the ego's own answer if it is sent as a message, bits, `(...)`, where messages hold
    # plans; else None
    own_bits: Floats | None = None
    own_text_bytes: Floats | None = None  # bytes of the text in it, `(...)`; else None
    # seconds from the decision's start until each helper may send, since it has sent something
    # unasked just before, `(..., H)`; None if none has to wait
    allowed_s: Floats | None = None
    # number of each helper in its episode, from 0, which it keeps when others leave, `(..., H)`, if
    # a rule needs it; -1 for all where helpers have several voices. Else None.
    numbers: Ints | None = None

    def take(self, at: Any) -> "Intents":
        """Return what vehicles intend in some of the decisions: those at `at` of the leading axis.

        `at` is an array of indices or a mask, by which all arrays are indexed.
        """
        return replace(
            self,
            site=self.site and self.site.take(at),
            outlook=self.outlook and self.outlook.take(at),
            claims=self.claims and self.claims.take(at),
            plans=self.plans and self.plans.take(at),
            **{name: taken(array, at) for name, array in self.arrays().items()},
        )

    def replaced(self, at: Ints, newer: "Intents") -> "Intents":
        """Return a copy in which some decisions have newer answers, as after helpers are asked.

        The decisions at indices `at`, `(k,)`, get the arrays of `newer`, which has k decisions in
        that order. `site`, `outlook`, `claims` and `plans` stay those of this object.
        """
        arrays = {name: array.copy() for name, array in self.arrays().items()}
        for name, values in newer.arrays().items():
            arrays[name][at] = values
        return replace(self, **arrays)

    def without_models(self) -> "Intents":
        """Return a copy for messages that list objects and need no answer of a helper's model.

        Every present helper is then valid (able to send), has an inference time of 0 s, and does
        not count as one whose model was not asked yet.
        """
        own_s = self.inference_s[..., :1]
        return replace(
            self,
            valid=np.isfinite(self.range_m),
            inference_s=np.concatenate([own_s, np.zeros(self.range_m.shape)], axis=-1),
            unasked=None,
        )

    def with_words(self) -> "Intents":
        """Return a copy for messages of words alone: without a text a helper has nothing to send.

        It is then not valid. A helper whose model was not asked yet stays valid.
        """
        text_bytes = np.zeros(self.valid.shape) if self.text_bytes is None else self.text_bytes
        unasked = np.zeros(self.valid.shape, dtype=bool) if self.unasked is None else self.unasked
        return replace(self, valid=self.valid & ((text_bytes > 0) | unasked))

    def planned(self, senders: Ints) -> "Intents":
        """Return a copy in which what helpers send are their own plans, not intents for the ego.

        Here each of the n decisions, a row, is of another agent: a vehicle that decides for itself
        and is the ego of its row. All decide at one time, so that each hears, as a helper, other
        agents of these rows. What a helper plans is `own` of its row; its size, its text and its
        inference time are taken from there, too. A helper that does not decide now is not valid,
        nor is one whose answer did not parse.

        Needs `plans`, `own_bits` and `own_text_bytes`.

        Args:
            senders: row, 0 to n-1, of the decision that each of the H helpers makes itself,
                `(n, H)`; -1 for one that does not decide now.
        """
        assert self.plans is not None
        assert self.own_bits is not None
        assert self.own_text_bytes is not None
        there = senders >= 0
        helpers = np.where(there[..., None], self.own[senders], np.nan)
        ready_s = np.where(there, self.inference_s[senders, 0], np.nan)
        return replace(
            self,
            helpers=helpers,
            valid=~np.isnan(helpers).any(axis=-1) & np.isfinite(self.range_m),
            payload_bits=np.where(there, self.own_bits[senders], 0.0),
            text_bytes=np.where(there, self.own_text_bytes[senders], 0.0),
            inference_s=np.concatenate([self.inference_s[:, :1], ready_s], axis=1),
            unasked=None,
            plans=self.plans.among(senders),
        )

    @classmethod
    def joined(cls, parts: "Sequence[Intents]") -> "Intents":
        """Return what vehicles intend in the decisions of several objects, one after another.

        `parts` are the objects. All must have the same numbers of helpers and actions, the same
        optional arrays, and None as `site`, `outlook`, `claims` and `plans`.
        """
        arrays = [part.arrays() for part in parts]
        joint: dict[str, Any] = {}
        for name in arrays[0]:
            joint[name] = np.concatenate([part[name] for part in arrays])
        return cls(**joint)

    def of_first(self, helpers: int) -> "Intents":
        """Return the same decisions with only the first `helpers` helpers, as a smaller scene has.

        `site`, `outlook` and `claims` must be None.
        """
        cut = {
            name: array[..., : helpers + (name in WITH_EGO)]
            for name, array in self.arrays().items()
            if name not in (*OF_EGO, "helpers")
        }
        return replace(self, helpers=self.helpers[..., :helpers, :], **cut)

    def of_helpers(self, places: Ints) -> "Intents":
        """Return the same n decisions with other helpers: in each those that `places` names.

        `places`, `(n, H')`, are indices of the H helpers here, from 0. One may be repeated, as an
        attacker is that sends as several vehicles.
        """
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        selected = {
            name: np.take_along_axis(array, with_ego if name in WITH_EGO else places, axis=-1)
            for name, array in self.arrays().items()
            if name not in (*OF_EGO, "helpers", "numbers")
        }
        helpers = np.take_along_axis(self.helpers, places[..., None], axis=-2)
        return replace(
            self,
            helpers=helpers,
            site=self.site and self.site.of_helpers(places),
            outlook=self.outlook and self.outlook.of_helpers(places),
            claims=self.claims and self.claims.of_helpers(places),
            plans=self.plans and self.plans.of_helpers(places),
            numbers=None if self.numbers is None else np.full_like(places, -1),
            **selected,
        )

    def arrays(self) -> dict[str, Any]:
        """Return the arrays of what vehicles intend, by name of the field, without those at None.

        It is for code that does the same to each, such as indexing. `site`, `outlook`, `claims` and
        `plans`, which are records of arrays, are left out.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value for name, value in values.items() if name not in PARTS and value is not None
        }


PARTS = ("site", "outlook", "claims", "plans")
OF_EGO = ("own", "own_bits", "own_text_bytes")  # arrays without a column for each vehicle
WITH_EGO = ("distance_m", "inference_s")  # arrays whose first column is the ego's
