"""The base of radio models with background traffic:
a power budget, and requests and replies over it.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.config import between, check
from harness.core.errors import UserError
from harness.extensions.radio.propagation import Propagation
from harness.radio.channel import Broadcast, Delivery, Draws, Links, Physical, Site

# Steps of a model's tables: of distance between rows, and of received power between columns.
STEP_M, STEP_DB = 10.0, 0.5


@dataclass(frozen=True)
class Transceiver(Propagation, Physical):
    """Model the radio of all vehicles under background traffic of one packet size and rate.

    Background traffic is other vehicles' packets, which compete for the channel with the messages
    of the ego and its helpers: `density_per_km` vehicles on a kilometre of road send `rate_hz`
    packets a second each. Fields, and those of `Propagation`, are settings of a radio: every
    vehicle sends with `power_dbm`, an antenna has the gain `gain_dbi`, and receivers
    `noise_figure_db`; `sensing_dbm` is the least power at which a packet is received or sensed.
    """

    # background vehicles on one kilometre of road, all lanes and both directions together
    density_per_km: Annotated[float, between(0, 10000)] = 100.0
    rate_hz: Annotated[float, between(0, 1000)] = 10.0  # packets that each of them sends a second
    power_dbm: Annotated[float, between(-100, 100)] = 23.0  # transmit power of every vehicle
    gain_dbi: Annotated[float, between(-50, 50)] = 0.0  # gain of each antenna
    noise_figure_db: Annotated[float, between(0, 50)] = 9.0  # noise figure of the receivers
    # least power of a whole packet at which it is received or sensed
    sensing_dbm: Annotated[float, between(-200, 50)] = -90.5

    def __post_init__(self) -> None:
        check(self)
        if not self.antenna_m >= self.environment_height_m + 0.1:
            raise UserError(
                f"antenna_m is {self.antenna_m}: give {self.environment_height_m + 0.1:g} or more"
            )

    @abstractmethod
    def wait_s(self, uniforms: Floats) -> Floats:
        """Return the seconds from the wish to send until sending begins, one for each draw.

        `uniforms`, `(...)`, are draws in [0, 1): the result, `(...)`, is the quantiles of the wait
        at these.
        """

    @abstractmethod
    def message_s(self, bits: Floats | float) -> Floats:
        """Return the time on air, s, of messages of so many bits, of the shape of `bits`."""

    @property
    @abstractmethod
    def packet_bits(self) -> int:
        """Return the size of a background packet, one of the other vehicles', in bits."""

    @abstractmethod
    def _fate(self, distance_m: Floats, power_dbm: Floats) -> Any:
        """Return the part of the losses at these received powers that does not depend on message
        size.
        """

    @abstractmethod
    def _lost(self, fate: Any, bits: Floats | float) -> Floats:
        """Return the probability that a message of so many bits is lost,
        given the result of `_fate`.
        """

    @abstractmethod
    def _turns(
        self, links: Links, begins_s: Floats, airtime_s: Floats, uniforms: Floats, replied: Bools
    ) -> tuple[Bools, Floats]:
        """Resolve how replies affect each other:
        which survive, and when each has ended, all `(..., H)`.

        `uniforms` are the draws that chose when each begins;
        `replied` says which helpers have the request.
        """

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        """Return the probability that a message is lost on each of H links, `(..., H)`.

        A link is that of the ego and one helper. `site` has their positions, `bits` is the
        message's size, one number or `(..., H)`, and `shadow` each link's shadowing (its change of
        power by what stands around), `(..., H)`, standard normal. Values for absent helpers mean
        nothing.
        """
        return self._lost(self._fate_at(site, shadow), bits)

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Return when all helpers have the ego's broadcast request, and its time on air, s.

        They have it after the ego's wait for the medium, of which `draws` has the random numbers,
        and the time on air. `bits` is the request's size, one number or `(...)`.
        """
        airtime_s = self.message_s(bits)
        return Broadcast(self.wait_s(draws.wait) + airtime_s, airtime_s)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        fate = self._fate_at(links.where, draws.shadow(links.where.xy_m, self.decorrelation_m))
        request_loss, loss = (
            self._lost(fate, bits) for bits in (links.request_bits, links.payload_bits)
        )
        airtime_s = self.message_s(links.payload_bits)
        replied = links.asked & (draws.packet[..., 0] >= request_loss)
        begins_s = links.ready_s + self.wait_s(draws.jitter)
        clear, end_s = self._turns(links, begins_s, airtime_s, draws.jitter, replied)
        return Delivery(replied & (draws.packet[..., 1] >= loss) & clear, end_s, loss, airtime_s)

    def received_dbm(self, path_loss_db: Floats) -> Floats:
        return self.power_dbm + 2 * self.gain_dbi - path_loss_db

    def _fate_at(self, site: Site, shadow: Floats) -> Any:
        mean_dbm = self.received_dbm(self.path_loss_db(site.distance_m, *site.between))
        return self._fate(site.distance_m, mean_dbm + self.shadowing_db(*site.between) * shadow)

    def _read(
        self, table: Floats, distance_m: Floats, power_dbm: Floats, first_db: float
    ) -> Floats:
        """Interpolate a table `(D, P)` whose first column is `first_db` above the sensing
        threshold.
        """
        row, down = _place(distance_m / STEP_M, table.shape[0])
        step = (power_dbm - self.sensing_dbm - first_db) / STEP_DB
        column, along = _place(step, table.shape[1])
        here, below = table[row, column], table[row + 1, column]
        beside, across = table[row, column + 1], table[row + 1, column + 1]
        left, right = here + down * (below - here), beside + down * (across - beside)
        return np.asarray(left + along * (right - left))


def _place(at: Floats, n: int) -> tuple[Ints, Floats]:
    """Return between which of n places some numbers lie, as the first of the two and the share.

    Beyond the ends they are at these. An absent helper's are NaN, and read somewhere.
    """
    within = np.clip(np.nan_to_num(at), 0, n - 1)
    first = np.minimum(within.astype(int), n - 2)
    return first, within - first
