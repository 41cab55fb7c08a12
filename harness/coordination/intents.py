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
from harness.core.arrays import Bools, Floats, Ints
from harness.radio.channel import Site


@dataclass(frozen=True)
class Intents:
    """Hold, for decisions `(...)` with H helpers and A actions, each vehicle's answer and its cost.

    The intent of a vehicle is its probabilities of the ego's actions. Beside them are distances,
    sizes of replies, inference times, and what optional parts of coordination need.
    """

    own: Floats  # the ego's intent, `(..., A)`; a row with a NaN is a failed answer
    helpers: Floats  # helpers' intents, `(..., H, A)`
    # whether the helper exists and its answer parsed, `(..., H)`. Any other helper sends nothing,
    # takes no slot, and may hold NaN in every array
    valid: Bools
    # distance to the centroid of the conflict zone, `(..., 1+H)`, the ego first; that of a helper
    # is as the ego knows it, from beacons
    distance_m: Floats
    range_m: Floats  # distance to the ego, `(..., H)`, as the ego knows it
    payload_bits: Floats  # size of the reply, `(..., H)`
    inference_s: Floats  # seconds of inference, `(..., 1+H)`, the ego first; NaN where unknown
    site: Site | None = None  # where the vehicles truly are, if the channel needs it; else None
    # whether the helper, if asked, sends nothing in its slot, `(..., H)`. None if no helper is
    silent: Bools | None = None
    # index of the vehicle behind each of the H voices, `(..., H)`. None if each vehicle has one
    # voice
    voice_of: Ints | None = None
    # what the ego sees and what helpers would add, if a schedule needs it; else None
    outlook: Outlook | None = None
    # what helpers claim about themselves, if a rule or an attack needs it; else None
    claims: Claims | None = None
    # bytes of each reply's text, `(..., H)`; None if replies have none
    text_bytes: Floats | None = None
    # how many objects each helper lists, `(..., H)`, if messages hold objects; else None
    objects: Floats | None = None
    object_bits: Floats | None = None  # size of these lists as compact JSON, `(..., H)`
    # whether the helper's model was not asked yet, `(..., H)`; until then it counts as valid. None
    # if the models of all were
    unasked: Bools | None = None
    # what agents say of themselves, if messages hold plans; of the agent alone, `(..., 1)`, until
    # it is known whom it hears. Else None
    plans: Plans | None = None
    # size of the agent's own answer as a reply, and bytes of its text, `(...)`, if messages hold
    # plans
    own_bits: Floats | None = None
    own_text_bytes: Floats | None = None

    def take(self, at: Any) -> "Intents":
        """Return the decisions at indices `at` of the leading dimension."""
        return replace(
            self,
            site=self.site and self.site.take(at),
            outlook=self.outlook and self.outlook.take(at),
            claims=self.claims and self.claims.take(at),
            plans=self.plans and self.plans.take(at),
            **{name: array[at] for name, array in self.arrays().items()},
        )

    def replaced(self, at: Ints, newer: "Intents") -> "Intents":
        """Return a copy whose decisions at indices `at` have the arrays of `newer`.

        `site`, `outlook`, `claims` and `plans` stay those of this object.
        """
        arrays = {name: array.copy() for name, array in self.arrays().items()}
        for name, values in newer.arrays().items():
            arrays[name][at] = values
        return replace(self, **arrays)

    def without_models(self) -> "Intents":
        """Return the intents for messages that list objects and need no answer of a helper's model.

        Every present helper is then valid, has an inference time of 0 s, and is not waited for.
        """
        own_s = self.inference_s[..., :1]
        return replace(
            self,
            valid=np.isfinite(self.range_m),
            inference_s=np.concatenate([own_s, np.zeros(self.range_m.shape)], axis=-1),
            unasked=None,
        )

    def with_words(self) -> "Intents":
        """Return the intents for messages of words alone: without a text a helper is not valid.

        A helper whose model was not asked yet stays valid.
        """
        text_bytes = np.zeros(self.valid.shape) if self.text_bytes is None else self.text_bytes
        unasked = np.zeros(self.valid.shape, dtype=bool) if self.unasked is None else self.unasked
        return replace(self, valid=self.valid & ((text_bytes > 0) | unasked))

    def planned(self, senders: Ints) -> "Intents":
        """Return the intents of n agents, each with the plans of the H agents that it hears.

        Decisions are of agents that decide at one time, one a row; `senders`, `(n, H)`, has the row
        of each sender, -1 for a vehicle that does not decide now. Such a vehicle, and an agent
        whose answer did not parse, is not valid. Needs `plans`, `own_bits` and `own_text_bytes`.
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
        """Return the decisions of all `parts`, concatenated along the leading dimension.

        All must have the same number of vehicles and no `site`, `outlook`, `claims` or `plans`.
        """
        arrays = [part.arrays() for part in parts]
        joint: dict[str, Any] = {}
        for name in arrays[0]:
            joint[name] = np.concatenate([part[name] for part in arrays])
        return cls(**joint)

    def of_first(self, helpers: int) -> "Intents":
        """Return the decisions with only the first `helpers` helpers of each.

        There must be no `site`, `outlook` or `claims`.
        """
        cut = {
            name: array[..., : helpers + (name in WITH_EGO)]
            for name, array in self.arrays().items()
            if name not in (*OF_EGO, "helpers")
        }
        return replace(self, helpers=self.helpers[..., :helpers, :], **cut)

    def of_helpers(self, places: Ints) -> "Intents":
        """Return decisions `(n, H)` with the helpers at indices `places`, `(n, H')`, from 0.

        An index may be repeated: one vehicle then speaks with several voices.
        """
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        selected = {
            name: np.take_along_axis(array, with_ego if name in WITH_EGO else places, axis=-1)
            for name, array in self.arrays().items()
            if name not in (*OF_EGO, "helpers")
        }
        helpers = np.take_along_axis(self.helpers, places[..., None], axis=-2)
        return replace(
            self,
            helpers=helpers,
            site=self.site and self.site.of_helpers(places),
            outlook=self.outlook and self.outlook.of_helpers(places),
            claims=self.claims and self.claims.of_helpers(places),
            plans=self.plans and self.plans.of_helpers(places),
            **selected,
        )

    def arrays(self) -> dict[str, Any]:
        """Return the array fields that are not None, by field name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value for name, value in values.items() if name not in PARTS and value is not None
        }


PARTS = ("site", "outlook", "claims", "plans")
OF_EGO = ("own", "own_bits", "own_text_bytes")  # arrays without a column for each vehicle
WITH_EGO = ("distance_m", "inference_s")  # arrays whose first column is the ego's
