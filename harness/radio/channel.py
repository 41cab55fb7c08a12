"""The V2V channel: which replies cross it, and when they have arrived.

A consultation is a round trip, so the request and the reply must both cross. A new model is a file beside
this one, with a frozen record that has `request` and `deliver`; its profiles are in `profiles.py`.
"""

from collections.abc import Mapping
from dataclasses import Field, dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError
from harness.radio.fading import Trips

# What stands between two antennas.
CLEAR, VEHICLE, BUILDING = 0, 1, 2


class Unit(NamedTuple):
    """A roadside unit, which stays where it is.

    Attributes:
        x_m: m to the east of the centroid of the conflict zone.
        y_m: m to the south of it.
        antenna_m: height of its antenna.
    """

    x_m: float
    y_m: float
    antenna_m: float


@dataclass(frozen=True)
class Site:
    """Where the ego and its helpers truly are, and what stands between them.

    Attributes:
        xy_m: places, `(..., 1+H, 2)`, the ego's first; NaN for a helper that is not there.
        sight: what stands between the ego and each helper, `(..., H)`: CLEAR, VEHICLE or BUILDING.
        blocker_m: height of the tallest vehicle between them, `(..., H)`; 0 where there is none.
        corner_m: distance of the ego and of the helper to the crossing of their streets, `(..., H, 2)`; NaN
            where the streets do not cross.
        first_m: height of the antenna at the first place; None where it is as high as all others.
        units: the same from roadside units: of each a site with the unit first, the ego, then the helpers.
    """

    xy_m: Floats
    sight: Ints
    blocker_m: Floats
    corner_m: Floats
    first_m: float | None = None
    units: Mapping[Unit, "Site"] = field(default_factory=dict)

    @property
    def distance_m(self) -> Floats:
        """Between the ego and each helper, `(..., H)`."""
        apart: Floats = np.linalg.norm(self.xy_m[..., 1:, :] - self.xy_m[..., :1, :], axis=-1)
        return apart

    @property
    def between(self) -> tuple[Ints, Floats, Floats, float | None]:
        """What `Propagation` wants to know besides distances: sight, blocker, corner, the first's antenna."""
        return self.sight, self.blocker_m, self.corner_m, self.first_m

    def take(self, at: Any) -> "Site":
        """The sites at these places of the leading dimension."""
        units = {unit: its.take(at) for unit, its in self.units.items()}
        return Site(self.xy_m[at], self.sight[at], self.blocker_m[at], self.corner_m[at], self.first_m, units)

    def to(self, links: slice) -> "Site":
        """Some of the links alone, `(..., h)`."""
        xy_m = np.concatenate([self.xy_m[..., :1, :], self.xy_m[..., 1:, :][..., links, :]], axis=-2)
        sight, blocker_m = self.sight[..., links], self.blocker_m[..., links]
        return Site(xy_m, sight, blocker_m, self.corner_m[..., links, :], self.first_m)

    def of_helpers(self, places: Ints) -> "Site":
        """The same with the helpers of these places, `(n, H')`; one may come again."""
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        return Site(
            np.take_along_axis(self.xy_m, with_ego[..., None], axis=-2),
            np.take_along_axis(self.sight, places, axis=-1),
            np.take_along_axis(self.blocker_m, places, axis=-1),
            np.take_along_axis(self.corner_m, places[..., None], axis=-2),
            self.first_m,
            {unit: its.of_helpers(with_ego) for unit, its in self.units.items()},
        )


@dataclass(frozen=True)
class Draws:
    """The channel's draws in [0, 1); every operating point has the same.

    Attributes:
        link: request and reply of each helper, `(..., H, 2)`. Equal for all steps of an episode under
            block fading.
        jitter: delay of each reply, `(..., H)`.
        trips: whose the other draws are, which only physical radios make; None where there are none.
        given: draws of packets, `(..., 1+2H)`, in place of the trips'.
    """

    link: Floats
    jitter: Floats
    trips: Trips | None = None
    given: Floats | None = None

    def take(self, at: Any) -> "Draws":
        """The draws at these places of the leading dimension."""
        given = None if self.given is None else self.given[at]
        return Draws(self.link[at], self.jitter[at], self.trips and self.trips.take(at), given)

    def of_helpers(self, places: Ints) -> "Draws":
        """The draws of the helpers of these places, `(n, H')`; voices of one share its link."""
        link = np.take_along_axis(self.link, places[..., None], axis=-2)
        return Draws(link, np.take_along_axis(self.jitter, places, axis=-1), self.trips)

    @cached_property
    def packet(self) -> Floats:
        """Request and reply of each helper, `(..., H, 2)`, anew at every step."""
        return self._uniforms[..., 1:].reshape(*self.jitter.shape, 2)

    @cached_property
    def wait(self) -> Floats:
        """The request's wait for its turn, `(...)`, anew at every step."""
        return self._uniforms[..., 0]

    def shadow(self, xy_m: Floats, decorrelation_m: float) -> Floats:
        """Shadowing of each helper's link, `(..., H)`, standard normal: `fading.Trips.shadow`."""
        return self._trips.shadow(xy_m, decorrelation_m)

    def of(self, links: str) -> "Draws":
        """Draws of other links, by what they are for, such as those of a roadside unit."""
        return replace(self, trips=replace(self._trips, links=links), given=None)

    @cached_property
    def first_packets(self) -> Floats:
        """A wait and two packets of a link that is there without helpers too, `(..., 3)`."""
        return self._trips.uniforms(1)

    @cached_property
    def requested(self) -> "Draws":
        """The same where every request crosses, however much is lost."""
        given = self._uniforms.copy()
        given[..., 1::2] = 1.0
        return replace(self, given=given)

    @cached_property
    def _uniforms(self) -> Floats:
        return self._trips.uniforms(self.jitter.shape[-1]) if self.given is None else self.given

    @property
    def _trips(self) -> Trips:
        if self.trips is None:
            raise UserError(NO_SITE)
        return self.trips


NO_SITE = (
    "a physical radio needs vehicles that are somewhere, and the paper's study has none; "
    "take v2x or 6g, or `harness eval` and `harness drive`"
)


@dataclass(frozen=True)
class Links:
    """What a channel may need to know of the links between the ego and its helpers.

    Attributes:
        asked: who was asked, `(..., H)`. What is said of the others may be anything, NaN included.
        ready_s: seconds from the start of the request until the helper has heard it and has its own answer,
            `(..., H)`.
        range_m: ego-helper distance, `(..., H)`, as the ego knows it: a beacon's error off the true one.
        payload_bits: size of the reply, `(..., H)`.
        in_radius: who is there and in the ego's radius, asked or not, `(..., H)`.
        rounds: which of these open a round of their own, `(..., H)`.
        request_bits: size of the request.
        site: where they are; None where the channel is not `Physical`, or the world has no places.
    """

    asked: Bools
    ready_s: Floats
    range_m: Floats
    payload_bits: Floats
    in_radius: Bools
    rounds: Bools
    request_bits: float = 0.0
    site: Site | None = None

    @property
    def where(self) -> Site:
        """The site. Raises UserError in a world without places."""
        if self.site is None:
            raise UserError(NO_SITE)
        return self.site

    def take(self, at: Any) -> "Links":
        """The links of these places of the leading dimension."""
        return Links(
            self.asked[at], self.ready_s[at], self.range_m[at], self.payload_bits[at], self.in_radius[at],
            self.rounds[at], self.request_bits, self.site and self.site.take(at),
        )  # fmt: skip


class Broadcast(NamedTuple):
    """What the broadcast of a request takes.

    Attributes:
        heard_s: seconds from the decision to ask until the helpers have it, `(...)` or one number.
        airtime_s: seconds that it occupies the medium, `(...)` or one number.
    """

    heard_s: Floats | float
    airtime_s: Floats | float


class Delivery(NamedTuple):
    """What a channel does to the replies.

    Attributes:
        up: request and reply cross, `(..., H)`; anything where not asked.
        delay_s: seconds from the request to the end of the reply's slot, `(..., H)`; inf where not asked. A
            lost reply keeps its slot.
        loss: probability that one crossing (request or reply) is lost, `(..., H)`, or `(..., 1)` where all
            links have the same.
        airtime_s: seconds that the reply occupies the medium, `(..., H)`; anything where not asked, NaN where
            the model does not know.
    """

    up: Bools
    delay_s: Floats
    loss: Floats
    airtime_s: Floats


@runtime_checkable
class Channel(Protocol):
    """A frozen dataclass. The operating point's overrides replace the fields of these names."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """When helpers have a request, or any other broadcast, of so many bits, `(...)` or one number."""

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """What happens to the request and the reply of each link."""


@runtime_checkable
class Physical(Channel, Protocol):
    """A channel whose losses follow from where vehicles are and what stands between them.

    Only such a channel looks at `Links.site` and the draws of trips.
    """

    @property
    def decorrelation_m(self) -> float:
        """How far shadowing reaches (`fading.Trips.shadow`); inf where there is none."""

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        """Share of packets of the background's size that are received at these distances `(n,)`.

        Averaged over shadowing; without `sight`, over what stands between as the model's source has it.
        """

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        """Probability that a message of so many bits is lost, `(..., H)`, given each link's shadowing."""

    def busy_ratio(self) -> float:
        """Channel busy ratio under the background load; NaN where the model does not say."""


def served_s(ready_s: Floats, slot_s: Floats, range_m: Floats) -> Floats:
    """When each slot `(..., H)` on a serial medium ends: first come, first served; of equals, the nearest."""
    order = np.lexsort((range_m, ready_s), axis=-1)
    served_slot_s = np.take_along_axis(slot_s, order, axis=-1)
    busy_s = np.cumsum(served_slot_s, axis=-1)
    # A slot starts when the one before it ends or its helper is ready, whichever is later: the end of
    # slot k is the largest, over j <= k, of ready_j plus the slots j..k.
    waits_s = np.take_along_axis(ready_s, order, axis=-1) - (busy_s - served_slot_s)
    end_s = np.empty_like(busy_s)
    np.put_along_axis(end_s, order, busy_s + np.maximum.accumulate(waits_s, axis=-1), axis=-1)
    return end_s
