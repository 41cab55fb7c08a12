"""802.11p (ITS-G5, DSRC): broadcast under CSMA/CA in 10 MHz,
with the beacons of background traffic.

Sepulcre, Gonzalez-Martín, Gozalvez, Molina-Masegosa, Coll-Perales, "Analytical Models of the
Performance of IEEE 802.11p Vehicle to Vehicle Communications", IEEE TVT 71(1), 2022 (arXiv
2104.07923): numbers in brackets are its equations, and the defaults its own. A packet is lost below
the sensing threshold (12), to a receiver that is locked to another one's packet (14), to noise (24)
or to a collision (26): with a hidden node, or with one that hears the sender and ends its back-off
in the same slot. This model differs from the source:

- A link keeps its shadowing: `loss` is that at the power received, and `reception` the mean over
  shadowing, where the source multiplies means.
- Background traffic is a line of equal density,
  so a product over vehicles is the exponential of an integral.
- Nobody begins to send in the AIFS after a busy period either (`free_share`); the source counts
  only the busy time in (16), (18) and (22). Vehicles that waited for its end begin soon after it,
  close together (`crowding`).
- A message of another size than the background's collides with packets that begin while it is on
  air (so its own length counts), and with packets that were on air before (so their length counts).
- Replies that end their back-off in one slot are lost together; one that becomes ready while
  another is on air waits for its end. All helpers of an ego are assumed to hear each other. `loss`
  does not include that.

As in the source, a block error curve holds for frames of any size, a receiver that has locked to a
packet does not leave it for a stronger one, and all background vehicles are in line of sight. A
message is one frame of any length; 802.11 would split one of more than 2304 bytes.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.config import between
from harness.core.errors import UserError
from harness.core.quantiles import normal_quantile, normal_share
from harness.extensions.radio import back_off
from harness.extensions.radio.back_off import SLOT_S, free_share
from harness.extensions.radio.block_error import block_error
from harness.extensions.radio.propagation import noise_dbm
from harness.extensions.radio.transceiver import STEP_DB, STEP_M, Transceiver
from harness.radio.channel import CLEAR, VEHICLE, Links, served_s

BANDWIDTH_HZ = 10e6
SIFS_S, SYMBOL_S, PREAMBLE_S = 32e-6, 8e-6, 40e-6  # IEEE 802.11-2012, 10 MHz OFDM
SERVICE_AND_TAIL_BITS = 22
REACH_M, SENSED_M = 1000.0, 1500.0  # distances up to which vehicles interfere, and are sensed
STRONGEST_DB = 80.0  # highest power in the tables, above the sensing threshold
QUANTILES = 400  # quantiles of shadowing in `reception`
RATES_MBPS = (3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0, 27.0)
BY_BIT = "11p-goubet"  # a curve over the energy of a bit
# data rate of other curves, by the beginning of their name
CURVES_MBPS = {"11p-mcs2": 6.0, "11p-mcs4": 12.0}
IMPLEMENTATION = 0.37  # share of Shannon's rate that is reached: Wu et al., arXiv 2203.17114


class Hazards(NamedTuple):
    """Hold the mean number of others' packets that spoil one, by its distance and received power.

    Both tables are (D, P): D distances from sender to receiver in steps of `STEP_M`, and P received
    powers in steps of `STEP_DB`. `before` counts packets that began no later than the one, and
    `during` later ones for each second that it is on air.
    """

    # packets that began earlier or at the same time and that the receiver is locked to, or that
    # spoil this one, `(D, P)`
    before: Floats
    during: Floats  # later packets that spoil it, for each second that it is on air, `(D, P)`


@dataclass(frozen=True)
class ItsG5(Transceiver):
    """Model 802.11p (ITS-G5) under background traffic of packets of one size and rate.

    Background traffic is the packets of other vehicles, `density_per_km` on a kilometre of road, of
    `packet_bytes` each; layers below add `header_bytes` to a packet, and all are sent at
    `data_rate_mbps` (Mb/s). Vehicles listen before they send, and wait a random number of slots
    (the back-off, up to `contention_window`) once the medium has been idle for `aifs_slots`. It is
    the analytical model of Sepulcre et al. (IEEE TVT 71(1), 2022). Fields are its settings, with
    those of `Transceiver` and `Propagation`: `frequency_ghz` is the carrier's, `antenna_m` every
    antenna's height, less `environment_height_m` for its effect; `sensing_dbm` is the least power
    at which a packet is sensed, and `curve` names the loss of frames by their signal-to-noise ratio
    (`block_error`).
    """

    # carrier frequency, here the control channel's
    frequency_ghz: Annotated[float, between(0.1, 100)] = 5.89
    # see `Propagation`; the source's 0.5 m leaves effective antennas of 1 m
    environment_height_m: Annotated[float, between(0, 100)] = 0.5
    antenna_m: Annotated[float, between(0, 10)] = 1.5  # height of every antenna
    # background vehicles on one kilometre of road
    density_per_km: Annotated[float, between(0, 10000)] = 60.0
    # least power at which a packet is sensed
    sensing_dbm: Annotated[float, between(-200, 50)] = -85.0
    packet_bytes: Annotated[int, between(1, 2304)] = 190  # size of a background packet
    # bytes that the layers below add to a packet and to a message
    header_bytes: Annotated[int, between(0, 2304)] = 30
    # Mb/s, one of 802.11p's 3, 4.5, 6, 9, 12, 18, 24 and 27
    data_rate_mbps: Annotated[float, between(1, 100)] = 6.0
    # slots after SIFS in which nobody begins; 6 is that of best effort (EN 302 663)
    aifs_slots: Annotated[int, between(0, 15)] = 6
    # back-off is uniform from 0 to this number of slots; a broadcast never doubles it. There is
    # always a back-off, as after a packet of one's own
    contention_window: Annotated[int, between(1, 1023)] = 15
    # block error curve of frames, a name of `harness.extensions.radio.block_error`. `11p-goubet`,
    # the source's, is over the energy of a bit, so it holds for every rate. A curve of MCS 2 or 4
    # (6 or 12 Mb/s) is shifted for another rate by the additional SINR that an implementation at
    # 0.37 of Shannon's rate needs
    curve: str = "11p-goubet"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data_rate_mbps not in RATES_MBPS:
            allowed = ", ".join(f"{rate:g}" for rate in RATES_MBPS)
            raise UserError(
                f"its-g5: data_rate_mbps is {self.data_rate_mbps}; it must be one of {allowed}"
            )
        if self.curve != BY_BIT and self.curve[:8] not in CURVES_MBPS:
            raise UserError(
                f"its-g5: curve is {self.curve!r}; it must be {BY_BIT} or begin with 11p-mcs"
            )
        block_error(self.curve)

    @property
    def aifs_s(self) -> float:
        """Return the AIFS, s: how long the medium must be idle before a back-off counts down."""
        return SIFS_S + self.aifs_slots * SLOT_S

    def airtime_s(self, size_bytes: Floats | float) -> Floats:
        """Return the time on air of frames of `size_bytes`, headers included, s, of the same shape.

        It follows from the data rate, by IEEE 802.11-2012, 18.4.3.
        """
        bits_per_symbol = self.data_rate_mbps * 1e6 * SYMBOL_S
        symbols = np.ceil((8 * np.asarray(size_bytes) + SERVICE_AND_TAIL_BITS) / bits_per_symbol)
        return PREAMBLE_S + SYMBOL_S * symbols

    @property
    def packet_bits(self) -> int:
        """Return the size of a background packet (of other vehicles) without headers, in bits."""
        return 8 * self.packet_bytes

    @property
    def packet_s(self) -> float:
        return float(self.airtime_s(self.packet_bytes + self.header_bytes))

    def message_s(self, bits: Floats | float) -> Floats:
        return self.airtime_s(np.ceil(np.asarray(bits) / 8) + self.header_bytes)

    def busy_ratio(self) -> float:
        """Return the channel busy ratio, the share of time in which the medium is sensed as busy.

        It is by a fit to simulations (Sepulcre et al., equation 35), a parabola of the load by
        other vehicles' packets (34), fitted up to 1.3; beyond its maximum, 0.84 at a load of 1.84,
        it stays constant.
        """
        sensed_m = 2 * float(_sensed(self, np.arange(0.5, SENSED_M)).sum())
        load = min(
            self.density_per_km / 1000 * self.rate_hz * self.packet_s * sensed_m, 0.913 / 0.4962
        )
        return (-0.2481 * load + 0.913) * load + 0.003844 * (load > 0)

    def lost_share(self, sinr_db: Floats) -> Floats:
        if self.curve == BY_BIT:
            more_db = 10 * math.log10(self.data_rate_mbps * 1e6 / BANDWIDTH_HZ)
        else:
            more_db = _shannon_db(self.data_rate_mbps) - _shannon_db(CURVES_MBPS[self.curve[:8]])
        return block_error(self.curve)(sinr_db - more_db)

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        """Return the packet reception ratio, the share of packets received, at n distances, (n,).

        `distance_m` (n,) is in metres, and packets are those that other vehicles send all the time.
        It is averaged over shadowing (the slow change of power by what stands around); without
        `sight` (what stands between, such as `CLEAR`) also over clear and blocked links by the
        environment's shares.
        """
        shadow = normal_quantile((np.arange(QUANTILES) + 0.5) / QUANTILES)
        distance_m = np.asarray(distance_m, dtype=float)[:, None]

        def received(sight: Ints | int) -> Floats:
            mean_dbm = self.received_dbm(self.path_loss_db(distance_m, sight))
            unspoilt, spoils_hz = self._fate(
                distance_m, mean_dbm + self.shadowing_db(sight) * shadow
            )
            return np.asarray(np.mean(unspoilt * np.exp(-self.packet_s * spoils_hz), axis=-1))

        if sight is not None:
            return received(np.broadcast_to(sight, distance_m.shape[:1])[:, None])
        clear = self.clear_probability(distance_m[:, 0])
        return clear * received(CLEAR) + (1 - clear) * received(VEHICLE)

    def _turns(
        self, links: Links, begins_s: Floats, airtime_s: Floats, uniforms: Floats, replied: Bools
    ) -> tuple[Bools, Floats]:
        """Replies are sent one after another;
        those that end their back-off in one slot are lost together.
        """
        begins_s = np.where(links.asked, begins_s, np.inf)
        alone = np.sum(_near(begins_s, SLOT_S / 2), axis=-1) == 1
        return alone, served_s(begins_s, np.where(links.asked, airtime_s, 0.0), links.range_m)

    def _lost(self, fate: tuple[Floats, Floats], bits: Floats | float) -> Floats:
        unspoilt, spoils_hz = fate
        return 1 - unspoilt * np.exp(-self.message_s(bits) * spoils_hz)

    def _fate(self, distance_m: Floats, power_dbm: Floats) -> tuple[Floats, Floats]:
        """Return the probability to survive all losses that do not depend on a message's length.

        And the mean number of packets that would spoil it, for each second that it is on air.
        """
        sinr_db = power_dbm - noise_dbm(BANDWIDTH_HZ, self.noise_figure_db)
        before, during_hz = (self._read(met, distance_m, power_dbm, 0.0) for met in _hazards(self))
        sensed = power_dbm >= self.sensing_dbm
        return sensed * (1 - self.lost_share(sinr_db)) * np.exp(-before), during_hz

    def wait_s(self, uniforms: Floats) -> Floats:
        return np.interp(
            uniforms,
            *back_off.access(self.busy_ratio(), self.packet_s, self.aifs_s, self.contention_window),
        )


def _shannon_db(rate_mbps: float) -> float:
    """Return the SINR in dB that a rate needs with the implementation loss."""
    return 10 * math.log10(2 ** (rate_mbps * 1e6 / BANDWIDTH_HZ / IMPLEMENTATION) - 1)


def _sensed(radio: ItsG5, distance_m: Floats) -> Floats:
    """Return the probability (13) that vehicles at these distances sense each other's packets."""
    mean_dbm = radio.received_dbm(radio.path_loss_db(distance_m))
    return np.asarray(normal_share((mean_dbm - radio.sensing_dbm) / radio.shadowing_db()))


@lru_cache(maxsize=64)
def _hazards(radio: ItsG5) -> Hazards:
    per_m, rate_hz, packet_s = radio.density_per_km / 1000, radio.rate_hz, radio.packet_s
    distance_m = np.arange(0.0, REACH_M + STEP_M, STEP_M)
    power_dbm = radio.sensing_dbm + np.arange(0.0, STRONGEST_DB + STEP_DB, STEP_DB)
    from_receiver_m = np.arange(STEP_M / 2 - REACH_M, REACH_M, STEP_M)[:, None]
    apart_m = np.abs(from_receiver_m + distance_m)  # of interferer and sender: (interferers, D)

    heard, hears = _sensed(radio, np.abs(from_receiver_m)), _sensed(radio, apart_m)
    busy = radio.busy_ratio()
    alike = busy * _overlap(radio, apart_m)
    begins_hz = rate_hz / free_share(alike, packet_s, radio.aifs_s) * per_m * STEP_M
    slot_s = SLOT_S * back_off.crowding(busy, packet_s, radio.aifs_s, radio.contention_window)
    same_slot, hidden = slot_s * begins_hz * hears, begins_hz * (1 - hears)  # (22), (18)
    nearer = np.abs(from_receiver_m) < distance_m
    locked = (same_slot * nearer + packet_s * hidden) * heard  # (21), (16)
    before = same_slot * ~nearer + packet_s * hidden * (1 - heard)  # (32), (28)
    spoils = _spoils(radio, power_dbm, np.abs(from_receiver_m))
    return Hazards(locked.sum(axis=0)[:, None] + (spoils @ before).T, (spoils @ hidden).T)


def _overlap(radio: ItsG5, apart_m: Floats) -> Floats:
    """Return the share of what one vehicle senses that another senses as well,
    by their distance (20).
    """
    sensed = _sensed(radio, np.abs(np.arange(-SENSED_M, SENSED_M + 1)))
    shared = np.correlate(sensed, sensed, "full")[sensed.size - 1 :]
    return np.asarray(np.interp(apart_m, np.arange(shared.size), shared / shared[0]))


def _spoils(radio: ItsG5, power_dbm: Floats, interferer_m: Floats) -> Floats:
    """Return the probability (31) that a concurrent packet spoils one, `(P, interferers)`,
    noise excluded.
    """
    noise = noise_dbm(BANDWIDTH_HZ, radio.noise_figure_db)
    shadow, weights = np.polynomial.hermite_e.hermegauss(15)
    mean_dbm = radio.received_dbm(radio.path_loss_db(interferer_m))
    others_dbm = 10 * np.log10(
        10 ** (noise / 10) + 10 ** ((mean_dbm + radio.shadowing_db() * shadow) / 10)
    )
    lost = radio.lost_share(power_dbm[:, None, None] - others_dbm) @ (weights / weights.sum())
    survives = 1 - radio.lost_share(power_dbm - noise)[:, None]
    return np.asarray(np.clip(1 - (1 - lost) / np.maximum(survives, 1e-12), 0.0, 1.0))


def _near(at: Floats, within: float) -> Bools:
    """Return which of these times `(..., H)` are near each other, `(..., H, H)`;
    infinite ones never are.
    """
    finite = np.where(np.isfinite(at), at, np.nan)
    return np.asarray(np.abs(finite[..., :, None] - finite[..., None, :]) < within)
