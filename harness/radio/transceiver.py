"""What the radios beside background traffic have in common: a power budget, and a message's way over it."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from harness.core.arrays import Bools, Floats, Ints
from harness.radio.channel import Broadcast, Delivery, Draws, Links, Site
from harness.radio.propagation import Propagation

STEP_M, STEP_DB = 10.0, 0.5
"""Between the rows and the columns of a model's tables: distance and power received."""


@dataclass(frozen=True)
class Transceiver(Propagation):
    """Everybody's radio, and the background that sends packets of one size at one rate.

    Attributes:
        density_per_km: background vehicles on one kilometre of road, all lanes and both ways together.
        rate_hz: packets a second of each of them.
        power_dbm: transmit power of everyone.
        gain_dbi: gain of each antenna.
        noise_figure_db: of the receivers.
        sensing_dbm: least power at which a packet is received or sensed; of the whole packet.
    """

    density_per_km: float = 100.0
    rate_hz: float = 10.0
    power_dbm: float = 23.0
    gain_dbi: float = 0.0
    noise_figure_db: float = 9.0
    sensing_dbm: float = -90.5

    @abstractmethod
    def wait_s(self, uniforms: Floats) -> Floats:
        """Seconds from the wish to send until it begins: the quantiles at these draws."""

    @abstractmethod
    def message_s(self, bits: Floats | float) -> Floats:
        """How long a message of so many bits is on air."""

    @abstractmethod
    def busy_ratio(self) -> float:
        """Channel busy ratio under the background load."""

    @abstractmethod
    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        """Share of the background's packets received at these distances, `(n,)`: `channel.Physical`."""

    @property
    @abstractmethod
    def packet_bits(self) -> int:
        """Size of the background's packets."""

    @abstractmethod
    def _fate(self, distance_m: Floats, power_dbm: Floats) -> Any:
        """What becomes of messages that are received with these powers, whatever their size."""

    @abstractmethod
    def _lost(self, fate: Any, bits: Floats | float) -> Floats:
        """Probability that a message of so many bits is lost, of its fate."""

    @abstractmethod
    def _turns(
        self, links: Links, begins_s: Floats, airtime_s: Floats, uniforms: Floats, replied: Bools
    ) -> tuple[Bools, Floats]:
        """What replies do to each other, all `(..., H)`: whom none destroys, and when each has ended.

        Args:
            links: who was asked.
            begins_s: when each would begin.
            airtime_s: how long it is on air.
            uniforms: the draws that chose when it begins.
            replied: who has the request.
        """

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        """Probability that a message of so many bits is lost on each link, `(..., H)`, given its shadowing.

        Args:
            site: where the links are; links to helpers that are not there have any loss.
            shadow: standard normal, `(..., H)`.
            bits: `(..., H)` or one number.
        """
        return self._lost(self._fate_at(site, shadow), bits)

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """All helpers have it when it has waited for its turn and been on air."""
        airtime_s = self.message_s(bits)
        return Broadcast(self.wait_s(draws.wait) + airtime_s, airtime_s)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Each reply waits for a turn of its own."""
        fate = self._fate_at(links.where, draws.shadow(links.where.xy_m, self.decorrelation_m))
        request_loss, loss = (self._lost(fate, bits) for bits in (links.request_bits, links.payload_bits))
        airtime_s = self.message_s(links.payload_bits)
        replied = links.asked & (draws.packet[..., 0] >= request_loss)
        begins_s = links.ready_s + self.wait_s(draws.jitter)
        clear, end_s = self._turns(links, begins_s, airtime_s, draws.jitter, replied)
        return Delivery(replied & (draws.packet[..., 1] >= loss) & clear, end_s, loss, airtime_s)

    def received_dbm(self, path_loss_db: Floats) -> Floats:
        """Power received over such a loss."""
        return self.power_dbm + 2 * self.gain_dbi - path_loss_db

    def _fate_at(self, site: Site, shadow: Floats) -> Any:
        mean_dbm = self.received_dbm(self.path_loss_db(site.distance_m, *site.between))
        return self._fate(site.distance_m, mean_dbm + self.shadowing_db(*site.between) * shadow)

    def _read(self, table: Floats, distance_m: Floats, power_dbm: Floats, first_db: float) -> Floats:
        """A table `(D, P)` at these places; its first column is of `first_db` above the sensing threshold."""
        at = np.broadcast_arrays(distance_m / STEP_M, (power_dbm - self.sensing_dbm - first_db) / STEP_DB)
        # A helper that is not there has no place, and the table must be read somewhere.
        return map_coordinates(table, np.nan_to_num(at), order=1, mode="nearest")
