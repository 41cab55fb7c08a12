"""What coordination needs to know of a set of decisions."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from harness.coordination.claims import Claims
from harness.coordination.scheduling import Outlook
from harness.core.arrays import Bools, Floats, Ints
from harness.radio.channel import Site


@dataclass(frozen=True)
class Intents:
    """What every vehicle intends, and what the reply to a request would cost; H helpers, A actions.

    Attributes:
        own: the ego's intent, `(..., A)`; a row with a NaN is a failed answer.
        helpers: helpers' intents, `(..., H, A)`.
        valid: the helper exists and its answer parsed, `(..., H)`. Any other sends nothing, takes no
            slot, and may hold NaN in every array.
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`, the ego first; a helper's as
            the ego knows it, from beacons.
        range_m: distance to the ego, `(..., H)`, as the ego knows it.
        payload_bits: size of the reply, `(..., H)`.
        inference_s: seconds of inference, `(..., 1+H)`, the ego first; NaN where unknown.
        site: where the vehicles truly are, for a channel that needs it; else None.
        silent: the helper is asked and sends nothing in its slot, `(..., H)`. None: nobody.
        voice_of: place of the vehicle whose voice each of the H is, `(..., H)`, where one has several. None:
            each its own.
        outlook: what the ego sees and helpers would add, for a schedule that needs it; else None.
        claims: what helpers say of themselves, for a rule or an attack that needs it; else None.
    """

    own: Floats
    helpers: Floats
    valid: Bools
    distance_m: Floats
    range_m: Floats
    payload_bits: Floats
    inference_s: Floats
    site: Site | None = None
    silent: Bools | None = None
    voice_of: Ints | None = None
    outlook: Outlook | None = None
    claims: Claims | None = None

    def take(self, at: Any) -> "Intents":
        """The decisions at these places of the leading dimension."""
        return replace(
            self,
            site=self.site and self.site.take(at),
            outlook=self.outlook and self.outlook.take(at),
            claims=self.claims and self.claims.take(at),
            **{name: array[at] for name, array in self.arrays().items()},
        )

    @classmethod
    def joined(cls, parts: "Sequence[Intents]") -> "Intents":
        """Decisions of as many vehicles, one part below the other; none has parts of a scene."""
        arrays = [part.arrays() for part in parts]
        joint: dict[str, Any] = {name: np.concatenate([each[name] for each in arrays]) for name in arrays[0]}
        return cls(**joint)

    def of_first(self, helpers: int) -> "Intents":
        """The same with so many helpers, of decisions without parts of a scene."""
        cut = {
            name: array[..., : helpers + (name in WITH_EGO)]
            for name, array in self.arrays().items()
            if name not in ("own", "helpers")
        }
        return replace(self, helpers=self.helpers[..., :helpers, :], **cut)

    def of_helpers(self, places: Ints) -> "Intents":
        """The same with the helpers of these places `(n, H')`, of decisions `(n, H)`; one may come again."""
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        taken = {
            name: np.take_along_axis(array, with_ego if name in WITH_EGO else places, axis=-1)
            for name, array in self.arrays().items()
            if name not in ("own", "helpers")
        }
        helpers = np.take_along_axis(self.helpers, places[..., None], axis=-2)
        return replace(
            self,
            helpers=helpers,
            site=self.site and self.site.of_helpers(places),
            outlook=self.outlook and self.outlook.of_helpers(places),
            claims=self.claims and self.claims.of_helpers(places),
            **taken,
        )

    def arrays(self) -> dict[str, Any]:
        """Those that are there, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if name not in PARTS and value is not None}


PARTS = ("site", "outlook", "claims")
WITH_EGO = ("distance_m", "inference_s")  # arrays whose first column is the ego's
