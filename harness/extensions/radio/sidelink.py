"""The base of sidelink radios (LTE Mode 4, NR Mode 2): broadcasts under background load.

The model of Gonzalez-Martin, Sepulcre, Molina-Masegosa and Gozalvez (IEEE TVT 68(2), 2019; equation
numbers are theirs): a packet is lost because the receiver was sending (half duplex), because it
came too faintly to be sensed, because of noise, or because others chose its resource. The paper
averages over the shadowing of links in line of sight. `loss` is that of one link whose shadowing
and obstacles are known; `reception` averages it again, and in line of sight is the paper's curve.

Background vehicles stand evenly along a straight road through the receiver, with vehicles between
them if the environment has a probability for that. Swarm messages add no load. Two replies in one
slot and sub-channel are both lost; `loss` does not include that.
"""

from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.config import between
from harness.core.errors import UserError
from harness.core.quantiles import normal_share
from harness.extensions.radio.block_error import BlockError
from harness.extensions.radio.sps import Scheduling
from harness.extensions.radio.transceiver import STEP_DB, STEP_M, Transceiver
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Links

# Interferers farther away do not count, as in the source; longer links have this length's
# collisions.
FURTHEST_M = 1000

# Power cells above the sensing threshold; with the distances they form the grid of the success
# table.
CELLS = 160


@dataclass(frozen=True)
class Sidelink(Transceiver):
    """Model the common part of the sidelink radios LTE Mode 4 and NR Mode 2.

    Vehicles divide the channel into slots of time and sub-channels of frequency. A resource is what
    one packet takes, a block is what is sent in it, and each vehicle chooses its resources itself.
    Fields, and those of `Transceiver`, are settings of both: other vehicles send `rate_hz` packets
    a second each, `keep` is the probability that a vehicle keeps its resource, `transmissions` how
    often it sends each block, and `t1_slots` to `t2_slots` the slots after a message is ready in
    which it may be sent. `ranks` says that free resources are ranked by received power.
    """

    rate_hz: Annotated[float, between(0.1, 1000)] = 10.0  # packets that each vehicle sends a second
    # probability that a vehicle keeps its resource when it might choose a new one
    keep: Annotated[float, between(0, 1)] = 0.0
    # how often every vehicle sends each block (blind repetition). Given the link's shadowing,
    # copies are received independently, and not combined
    transmissions: Annotated[int, between(1, 100)] = 1
    # first slot of the selection window, counted from when the message is ready
    t1_slots: Annotated[int, between(0, 10000)] = 1
    # last slot of it. A message takes a random slot of the window (one-shot), since a triggered
    # message has no reservation
    t2_slots: Annotated[int, between(0, 10000)] = 100

    # Whether vehicles rank the remaining resources by received power (Step 3 of Mode 4).
    ranks: ClassVar[bool]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.t2_slots < self.t1_slots:
            raise UserError(f"t2_slots is {self.t2_slots}: give {self.t1_slots} or more")

    @property
    @abstractmethod
    def slot_s(self) -> float:
        """Return the length of a slot, s: the time on air of one block, a vehicle's packet."""

    @property
    @abstractmethod
    def blocks_per_slot(self) -> int:
        """Return how many blocks fit into one slot of time, side by side in frequency.

        A block is what one packet of a vehicle takes.
        """

    @property
    @abstractmethod
    def block_bits(self) -> int:
        """Return the bits in one block, what one packet takes: some frequency in one slot of time.

        A larger message takes several blocks, and all must arrive.
        """

    @property
    def packet_bits(self) -> int:
        return self.block_bits

    @property
    @abstractmethod
    def noise_dbm(self) -> float:
        """Return the noise power, dBm, of a receiver in the bandwidth of one packet."""

    @property
    @abstractmethod
    def block_error(self) -> BlockError:
        """Return the function that says how probably a block is lost, by its signal's strength.

        A block is what is coded and sent as one. The function takes ratios of signal to
        interference and noise (SINR) in dB, an array, and returns probabilities of the same shape.
        """

    def busy_ratio(self) -> float:
        return self._scheduling().busy_ratio

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        """Return the packet reception ratio, the share of packets received, at n distances, (n,).

        `distance_m` (n,) is in metres, and packets are those that other vehicles send all the time.
        It is equation 6 of Gonzalez-Martin et al. (2019), averaged over shadowing (the slow change
        of power by what stands around). `sight` is what stands between, such as `CLEAR`; without it
        no building does, and vehicles with the environment's probability.
        """
        distance_m = np.asarray(distance_m, dtype=np.float64)
        success = np.array(
            [np.interp(distance_m, _DISTANCE_M, column) for column in _success(self).T]
        ).T
        received: Floats = 1 - (1 - success) ** self.transmissions
        return np.asarray(np.sum(self._shares(distance_m, sight) * received, axis=-1))

    def wait_s(self, uniforms: Floats) -> Floats:
        return (self.t1_slots + np.floor(uniforms * self._window)) * self.slot_s

    def message_s(self, bits: Floats | float) -> Floats:
        """Return the time on air of a message of so many bits, s, of the shape of `bits`.

        A message takes several blocks if it is large, and each is sent several times; each takes
        one slot, one after another.
        """
        return self._blocks(bits) * (self.transmissions * self.slot_s)

    def _turns(
        self, links: Links, begins_s: Floats, airtime_s: Floats, uniforms: Floats, replied: Bools
    ) -> tuple[Bools, Floats]:
        """Each reply takes a random slot and sub-channel; replies that overlap are lost."""
        first = np.floor(begins_s / self.slot_s + 1e-6)
        after = first + np.rint(airtime_s / self.slot_s)
        # The rest of the draw that chose the slot chooses the sub-channel.
        lane = np.floor(np.mod(uniforms * self._window, 1.0) * self.blocks_per_slot)
        meet = (first[..., None] < after[..., None, :]) & (first[..., None, :] < after[..., None])
        meet &= (lane[..., None] == lane[..., None, :]) & replied[..., None, :]
        clash = np.asarray((meet & ~np.eye(begins_s.shape[-1], dtype=bool)).any(axis=-1))
        return ~clash, np.where(links.asked, begins_s + airtime_s, np.inf)

    @property
    def _window(self) -> int:
        return self.t2_slots - self.t1_slots + 1

    def _blocks(self, bits: Floats | float) -> Floats:
        return np.maximum(np.ceil(np.divide(bits, self.block_bits)), 1.0)

    def _lost(self, fate: Floats, bits: Floats | float) -> Floats:
        return 1 - (1 - fate) ** self._blocks(bits)

    def _fate(self, distance_m: Floats, power_dbm: Floats) -> Floats:
        success = self._read(_success(self), distance_m, power_dbm, STEP_DB / 2)
        copies = np.where(power_dbm >= self.sensing_dbm, (1 - success) ** self.transmissions, 1.0)
        return np.clip(copies, 0.0, 1.0)

    def _scheduling(self) -> Scheduling:
        return Scheduling(
            per_m=self.density_per_km / 1000 * self.transmissions,
            resources=self.blocks_per_slot / (self.slot_s * self.rate_hz),
            # A vehicle may choose a new resource once a second (5 to 15 packets at 10 Hz, 10 to 30
            # at 20 Hz).
            forgotten=min(1.0, (1 - self.keep) / self.rate_hz),
            sensed=self._sensed,
            threshold_dbm=self.sensing_dbm,
        )

    def _states(
        self, distance_m: Floats, sight: Ints | int | None
    ) -> list[tuple[Floats, Floats, float]]:
        """Return for each kind of obstacle:
        share `(n,)`, mean received power `(n,)` and deviation in dB.
        """
        clear = self.clear_probability(distance_m)
        shares = {CLEAR: clear, VEHICLE: 1 - clear}
        if sight is not None:
            shares = {
                state: (sight == state) * np.ones_like(clear)
                for state in (CLEAR, VEHICLE, BUILDING)
            }
        return [
            (
                share,
                self.received_dbm(self.path_loss_db(distance_m, state)),
                float(self.shadowing_db(state)),
            )
            for state, share in shares.items()
            if share.any()
        ]

    def _sensed(self, distance_m: Floats, threshold_dbm: float) -> Floats:
        """Return the share of packets from these distances that are above a threshold (11)."""
        states = self._states(distance_m, None)
        return np.asarray(
            sum(share * normal_share((mean - threshold_dbm) / sd) for share, mean, sd in states)
        )

    def _shares(self, distance_m: Floats, sight: Ints | int | None) -> Floats:
        """Return the shares of the power cells, `(n, CELLS)`;
        the rest to 1 is below the threshold (10).
        """
        edges = self.sensing_dbm + STEP_DB * np.arange(CELLS + 1)
        edges[-1] = np.inf
        states = self._states(distance_m, sight)
        below = np.zeros((len(distance_m), CELLS + 1))
        for share, mean, sd in states:
            below += share[:, None] * normal_share((edges - mean[:, None]) / sd)
        return np.diff(below, axis=-1)


_DISTANCE_M: Floats = np.arange(0.0, FURTHEST_M + STEP_M, STEP_M)


@lru_cache(maxsize=64)
def _success(radio: Sidelink) -> Floats:
    """Return the share of sensed packets that are received, by distance and received power,
    `(D, CELLS)`.
    """
    power_dbm: Floats = radio.sensing_dbm + STEP_DB * (np.arange(CELLS, dtype=np.float64) + 0.5)
    noise_lost = radio.block_error(power_dbm - radio.noise_dbm)
    shares = radio._shares(_DISTANCE_M, None) * (1 - noise_lost)
    shares /= np.maximum(shares.sum(axis=-1, keepdims=True), 1e-300)
    spacing_m = 1000 / radio.density_per_km if radio.density_per_km else np.inf
    interferers_m: Floats = spacing_m * np.arange(1.0, round(FURTHEST_M / spacing_m) + 1)
    hit = _hit(radio, power_dbm, noise_lost, interferers_m)

    scheduling = radio._scheduling()
    busy = min(max(2 * scheduling.busy_ratio - 0.4, 0.0), 1.0) if radio.ranks else 1.0  # (22)
    free, free_on_average = np.zeros(shares.shape), np.zeros(len(shares))
    for weight, same in (
        (busy, scheduling.same_by_exclusion),
        (1 - busy, scheduling.same_by_ranking),
    ):
        if weight:
            # Interferers stand on both sides of the receiver (14, 15).
            sides = [
                radio.transmissions * same(np.abs(_DISTANCE_M[:, None] + side * interferers_m))
                for side in (-1, 1)
            ]
            one, other = sides
            for_each = [_none(one[d] * hit, other[d] * hit) for d in range(len(shares))]
            free += weight * np.array(for_each)
            mean_hit = shares @ hit
            free_on_average += weight * _none(*(side * mean_hit for side in sides))
    # The source multiplies the interferers' average collisions. A link's own power is the same
    # against all of them, so the average of the products is a little larger; it is scaled to the
    # source's curve.
    average_free = np.sum(shares * free, axis=-1)
    scale = np.where(average_free > 0, free_on_average / np.maximum(average_free, 1e-300), 1.0)
    free *= scale[:, None]
    half_duplex = radio.rate_hz * radio.transmissions * radio.slot_s  # (7)
    success: Floats = max(1 - half_duplex, 0.0) * (1 - noise_lost) * free
    return success


def _none(left: Floats, right: Floats) -> Floats:
    """Return the probability that no interferer hits, over the last dimension."""
    return np.asarray(np.prod((1 - np.minimum(left, 1.0)) * (1 - np.minimum(right, 1.0)), axis=-1))


def _hit(radio: Sidelink, power_dbm: Floats, noise_lost: Floats, interferers_m: Floats) -> Floats:
    """Return the probability that an interferer on the same resource destroys a packet,
    `(P, K)` (17, 18).

    Packets that noise would destroy are excluded.
    The interferer's shadowing is integrated with 15 nodes.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    lost = np.zeros((len(power_dbm), len(interferers_m)))
    for share, mean_dbm, deviation_db in radio._states(interferers_m, None):
        interference_mw = 10 ** ((mean_dbm[:, None] + deviation_db * nodes) / 10)
        noise_db = 10 * np.log10(interference_mw + 10 ** (radio.noise_dbm / 10))
        lost += share * (
            radio.block_error(power_dbm[:, None, None] - noise_db) @ (weights / weights.sum())
        )
    left = 1 - noise_lost[:, None]
    return np.where(left > 0, (lost - noise_lost[:, None]) / np.where(left > 0, left, 1.0), 0.0)
