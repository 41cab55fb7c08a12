"""The interface of a V2V channel: which replies arrive, and when.

A consultation is a round trip: the request and the reply must both be received. A new model is a
file beside this one, with a frozen dataclass that has `request` and `deliver`; profiles are read by
`profiles.py`.
"""

from collections.abc import Mapping
from dataclasses import Field, dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats, Ints, Texts, taken
from harness.core.errors import UserError
from harness.radio.fading import Trips

# What stands between two antennas.
CLEAR, VEHICLE, BUILDING = 0, 1, 2


class Antenna(NamedTuple):
    """Hold where an antenna stands that is on no vehicle, such as one beside the road.

    The conflict zone is the area where other vehicles' paths meet the ego's.
    """

    x_m: float  # position, m to the east of the centroid of the conflict zone
    y_m: float  # position, m to the south of it
    height_m: float  # height above the ground, m


@dataclass(frozen=True)
class Site:
    """Hold where the ego and its H helpers truly are, and what stands between their antennas.

    A link is that of the ego and one helper. Arrays are of decisions of any shape `(...)`. On an
    axis of length 1+H index 0 is the ego and 1+h is helper h; on one of length H, index h is the
    link to helper h.
    """

    # positions, `(..., 1+H, 2)`, the ego's first: m to the east and to the south of the road's
    # origin; NaN for an absent helper
    xy_m: Floats
    # what stands between the ego and each helper, `(..., H)`: `CLEAR` (nothing), `VEHICLE` or
    # `BUILDING`, whole numbers of this module
    sight: Ints
    blocker_m: Floats  # height of the tallest vehicle between them, m, `(..., H)`; 0 without one
    # distance of the ego and of the helper to the crossing of their streets, m, `(..., H, 2)`; NaN
    # if the streets do not cross
    corner_m: Floats
    # height of the antenna at the first position, m; None if it is as high as all others
    first_m: float | None = None
    # the sites of antennas on no vehicle, by antenna: each site has the antenna in the ego's place,
    # then the ego and the helpers, so its `xy_m` is `(..., 2+H, 2)`
    antennas: Mapping[Antenna, "Site"] = field(default_factory=dict)
    # what the source of the traffic calls each vehicle, as `SCENE/NAME`, `(..., 1+H)`, empty for
    # one without a name; None where the scenario's vehicles have no names but those of this harness
    names: Texts | None = None
    # what the clock of that source shows, s, `(...)`; None without names
    time_s: Floats | None = None
    # whether that source has several scenes, so that a name without its scene may be of each
    several_scenes: bool = False

    @property
    def distance_m(self) -> Floats:
        apart: Floats = np.linalg.norm(self.xy_m[..., 1:, :] - self.xy_m[..., :1, :], axis=-1)
        return apart

    @property
    def between(self) -> tuple[Ints, Floats, Floats, float | None]:
        """Return the arguments of `Propagation.path_loss_db` that follow the distance.

        That method returns by how many dB a link weakens power. They are the obstacle, the
        blocker's height, the distances to the streets' crossing and the first antenna's height: the
        fields `sight`, `blocker_m`, `corner_m` and `first_m`.
        """
        return self.sight, self.blocker_m, self.corner_m, self.first_m

    def take(self, at: Any) -> "Site":
        """Return the sites of the decisions at `at`, indices or a mask of the leading axis."""
        antennas = {antenna: site.take(at) for antenna, site in self.antennas.items()}
        return Site(
            self.xy_m[at],
            self.sight[at],
            self.blocker_m[at],
            self.corner_m[at],
            self.first_m,
            antennas,
            None if self.names is None else self.names[at],
            None if self.time_s is None else self.time_s[at],
            self.several_scenes,
        )

    def select(self, links: slice) -> "Site":
        """Return the site with only the helpers in `links`, a slice of the H, without antennas."""
        xy_m = np.concatenate(
            [self.xy_m[..., :1, :], self.xy_m[..., 1:, :][..., links, :]], axis=-2
        )
        sight, blocker_m = self.sight[..., links], self.blocker_m[..., links]
        corner_m, names = self.corner_m[..., links, :], self.names
        if names is not None:
            names = np.concatenate([names[..., :1], names[..., 1:][..., links]], axis=-1)
        return replace(
            self,
            xy_m=xy_m,
            sight=sight,
            blocker_m=blocker_m,
            corner_m=corner_m,
            antennas={},
            names=names,
        )

    def of_helpers(self, places: Ints) -> "Site":
        """Return the site with other helpers: in each of n decisions those that `places` names.

        `places`, `(n, H')`, are indices of helpers here, from 0; one may be repeated.
        """
        with_ego = np.insert(places + 1, 0, 0, axis=-1)
        return Site(
            np.take_along_axis(self.xy_m, with_ego[..., None], axis=-2),
            np.take_along_axis(self.sight, places, axis=-1),
            np.take_along_axis(self.blocker_m, places, axis=-1),
            np.take_along_axis(self.corner_m, places[..., None], axis=-2),
            self.first_m,
            {antenna: site.of_helpers(with_ego) for antenna, site in self.antennas.items()},
            None if self.names is None else np.take_along_axis(self.names, with_ego, axis=-1),
            self.time_s,
            self.several_scenes,
        )


@dataclass(frozen=True)
class Draws:
    """Hold the channel's uniform random numbers in [0, 1), the same for every operating point.

    They are of the links between the ego and H helpers, in decisions of any shape `(...)`. An
    operating point is the settings of radio, asking and fusion. A message is lost if its draw is
    below the probability of a loss, so that more loss loses the same messages and others.
    """

    # for channels of one loss: draws of the request to each helper and of its reply, `(..., H, 2)`;
    # equal for all steps of an episode where a link that is lost stays lost (block fading)
    link: Floats
    jitter: Floats  # for such channels: a draw of each reply's delay, `(..., H)`
    # for physical channels, whose loss depends on positions: the keys from which all further draws
    # are made; None if there are none
    trips: Trips | None = None
    # draws of packets in place of those made from `trips`, `(..., 1+2H)`: first one for the
    # request's wait, then of each helper a pair (request, reply); None makes them from `trips`
    given: Floats | None = None

    def take(self, at: Any) -> "Draws":
        """Return the draws of the decisions at `at`, indices or a mask of the leading axis."""
        given = None if self.given is None else taken(self.given, at)
        link, jitter = taken(self.link, at), taken(self.jitter, at)
        return Draws(link, jitter, self.trips and self.trips.take(at), given)

    def of_helpers(self, places: Ints) -> "Draws":
        """Return the draws for other helpers: in each of n decisions those that `places` names.

        `places`, `(n, H')`, are indices of helpers here, from 0. A repeated one has the same draws
        of its link.
        """
        link = np.take_along_axis(self.link, places[..., None], axis=-2)
        jitter = np.take_along_axis(self.jitter, places, axis=-1)
        return Draws(link, jitter, self.trips and replace(self.trips, helpers=None))

    def numbered(self, numbers: Ints) -> "Draws":
        """Return the draws for helpers that have `numbers` in their episodes, `(n, H')`, from 0.

        These draws must be of all numbers, in their order.
        """
        draws = self.of_helpers(numbers)
        return replace(draws, trips=self.trips and replace(self.trips, helpers=numbers))

    @property
    def numbers(self) -> Ints:
        """Return the number of each helper in its episode, `(..., H)`, by which its draws are."""
        if self.trips is not None and self.trips.helpers is not None:
            return self.trips.helpers
        return np.broadcast_to(np.arange(self.jitter.shape[-1]), self.jitter.shape)

    @cached_property
    def packet(self) -> Floats:
        """Return draws for the loss of the request to each helper and of its reply, `(..., H, 2)`.

        They are new at every step of an episode.
        """
        return self._uniforms[..., 1:].reshape(*self.jitter.shape, 2)

    @cached_property
    def wait(self) -> Floats:
        """Return draws for how long the request waits for a free medium, `(...)`.

        They are new at every step of an episode.
        """
        return self._uniforms[..., 0]

    def shadow(self, xy_m: Floats, decorrelation_m: float) -> Floats:
        """Return the shadowing of each helper's link, `(..., H)`, standard normal.

        Shadowing is the slow change of received power by what stands around. `xy_m` are positions
        of the ego and its helpers, m, `(..., 1+H, 2)`; the correlation is 1/e when both ends of a
        link have moved `decorrelation_m`.
        """
        return self._trips.shadow(xy_m, decorrelation_m)

    def of(self, links: str) -> "Draws":
        """Return independent draws for other links, such as an antenna's.

        `links` is their name, any text: the same name gives the same draws.
        """
        return replace(self, trips=replace(self._trips, links=links), given=None)

    @cached_property
    def latency(self) -> Floats:
        """Return draws for the latency of the request to each helper and its reply, `(..., H, 2)`.

        They are new at every step of an episode.
        """
        return self.of(f"{self._trips.links}.latency").packet

    @cached_property
    def of_one(self) -> "Draws":
        """Return the draws for one link alone, as if H were 1, even if there are no helpers.

        That is the link of the ego and an antenna on no vehicle.
        """
        none = np.zeros((*self.jitter.shape[:-1], 1))
        return Draws(np.stack([none, none], axis=-1), none, replace(self._trips, helpers=None))

    @cached_property
    def requested(self) -> "Draws":
        """Return the same draws, but with requests that are always received, whatever the loss."""
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
    """Hold what a channel must know of the links between the ego and its H helpers.

    Arrays are of decisions of any shape `(...)`; index h of an axis of length H is helper h. Values
    for a helper that was not asked may be anything, even NaN.
    """

    asked: Bools  # which helpers were asked, `(..., H)`
    # seconds from the start of the request until the helper has heard it and has its own answer,
    # `(..., H)`
    ready_s: Floats
    # each helper's distance to the ego, m, `(..., H)`, as the ego knows it, with a beacon's error
    range_m: Floats
    payload_bits: Floats  # size of each helper's reply, bits, `(..., H)`
    # which helpers are present and near enough to be asked, asked or not, `(..., H)`
    in_radius: Bools
    # which of these are unsure themselves and open a round of asking of their own, which loads the
    # channel, `(..., H)`
    rounds: Bools
    request_bits: float = 0.0  # size of the request, bits
    # positions; None if the channel is not `Physical`, or the world has no positions
    site: Site | None = None

    @property
    def where(self) -> Site:
        """Return the site, which has positions. Raises UserError in a world without positions."""
        if self.site is None:
            raise UserError(NO_SITE)
        return self.site

    def take(self, at: Any) -> "Links":
        """Return the links of the decisions at `at`, indices or a mask of the leading axis."""
        return Links(
            self.asked[at],
            self.ready_s[at],
            self.range_m[at],
            self.payload_bits[at],
            self.in_radius[at],
            self.rounds[at],
            self.request_bits,
            self.site and self.site.take(at),
        )


# The place of a message's draw among those of its link: a request or another broadcast, or a reply.
Way = Literal[0, 1]
REQUEST: Way = 0
REPLY: Way = 1


class Broadcast(NamedTuple):
    """Hold when a broadcast request is received and how long it is on air.

    It is one message to all helpers, in each of the decisions `(...)`.
    """

    # seconds from the decision to ask until the helpers have the request, `(...)` or one number;
    # NaN if it depends on the link (`ByLink`)
    heard_s: Floats | float
    airtime_s: Floats | float  # seconds that it occupies the medium, `(...)` or one number


class Delivery(NamedTuple):
    """Hold which of H helpers' replies are received on a channel, and when.

    Arrays are of decisions of any shape `(...)`; index h of an axis of length H is helper h.
    """

    # whether request and reply are received, `(..., H)`; anything for helpers that were not asked
    up: Bools
    # seconds from the request to the end of the reply's slot, `(..., H)`; inf for helpers that were
    # not asked. A lost reply keeps its slot.
    delay_s: Floats
    # probability that one transmission, a request or a reply, is lost, `(..., H)`; `(..., 1)` if
    # all links have the same
    loss: Floats
    # seconds that the reply occupies the medium, `(..., H)`; anything for helpers that were not
    # asked, NaN if the model does not know it
    airtime_s: Floats


@runtime_checkable
class Channel(Protocol):
    """Describe a channel model: who receives a message over the radio, and when.

    It is a frozen dataclass; its fields are settings that a condition of a run may override.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Return when helpers have received a broadcast request, and how long it is on air.

        `bits` is the request's size in bits, in each decision, `(...)`, or in all, one number; the
        times have the same shape. `draws` are the channel's random numbers.
        """

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Return whether, and when, the request to each helper and its reply are received.

        `links` has who was asked, how far each is, when its reply is ready, and the sizes of
        messages; `draws` are the channel's random numbers.
        """


@runtime_checkable
class Physical(Channel, Protocol):
    """Describe a channel whose losses depend on the vehicles' positions and on obstacles.

    Only such a channel reads `Links.site` and the draws of shadowing and packets. It does not read
    `Links.in_radius`.
    """

    @property
    def decorrelation_m(self) -> float:
        """Return the distance at which shadowing's correlation is 1/e, m; inf without shadowing.

        Shadowing is the slow change of received power by what stands around.
        """

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        """Return the share of background packets that are received at distances, `(n,)`.

        `distance_m`, `(n,)`, are m between the antennas. Background packets are what other vehicles
        send, such as beacons. `sight` is the obstacle between the antennas, such as `CLEAR`, one
        for all or `(n,)`. The share is a mean over shadowing, the slow change of received power by
        what stands around, and without `sight` also over obstacles as often as the model's source
        has them.
        """

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        """Return the probability that a message is lost on each of H links, `(..., H)`.

        `site` has the positions. `shadow` is each link's shadowing, `(..., H)`, a standard normal
        number: the slow change of received power by what stands around. `bits` is the message's
        size in bits, one for all or `(..., H)`.
        """

    def busy_ratio(self) -> float:
        """Return the share of time, 0 to 1, that the channel is busy with others' packets.

        These are background packets, such as beacons, not the messages of a decision. NaN if the
        model does not know it.
        """


@runtime_checkable
class ByLink(Physical, Protocol):
    """Describe a physical channel on which a message's latency depends on its link."""

    def latencies_s(self, site: Site, draws: Draws, way: Way) -> Floats:
        """Return the seconds from the wish to send until reception on each of H links, `(..., H)`.

        `site` has the positions and `draws` the channel's random numbers. `way` is `REQUEST` or
        `REPLY`: the index on the last axis of `draws.latency` of the random numbers that the
        latency may depend on.
        """


def served_s(ready_s: Floats, slot_s: Floats, range_m: Floats) -> Floats:
    """Return when each of H replies ends on a medium that carries one after another, s, `(..., H)`.

    Replies are sent in the order in which they are ready, of equal ones the nearest first. All
    arguments are `(..., H)`: `ready_s` is when a helper's reply can leave, `slot_s` how long the
    medium is then taken by it, and `range_m` the helper's distance to the ego, m.
    """
    order = np.lexsort((range_m, ready_s), axis=-1)
    served_slot_s = np.take_along_axis(slot_s, order, axis=-1)
    busy_s = np.cumsum(served_slot_s, axis=-1)
    # A slot starts when the one before it ends or its helper is ready, whichever is later: the end
    # of slot k is the largest, over j <= k, of ready_j plus the slots j..k.
    waits_s = np.take_along_axis(ready_s, order, axis=-1) - (busy_s - served_slot_s)
    end_s = np.empty_like(busy_s)
    np.put_along_axis(end_s, order, busy_s + np.maximum.accumulate(waits_s, axis=-1), axis=-1)
    return end_s
