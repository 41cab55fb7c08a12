"""What coordination needs to know of a set of decisions."""

from dataclasses import dataclass, fields, replace
from typing import Any

from harness.core.arrays import Bools, Floats
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
    """

    own: Floats
    helpers: Floats
    valid: Bools
    distance_m: Floats
    range_m: Floats
    payload_bits: Floats
    inference_s: Floats
    site: Site | None = None

    def take(self, at: Any) -> "Intents":
        """The decisions at these places of the leading dimension."""
        site = self.site and self.site.take(at)
        return replace(self, **{name: getattr(self, name)[at] for name in ARRAYS}, site=site)


ARRAYS = tuple(field.name for field in fields(Intents) if field.name != "site")
