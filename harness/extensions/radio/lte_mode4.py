"""LTE-V2X Mode 4: vehicles choose their resources themselves,
by sensing and semi-persistent scheduling.

Parameters are those of Gonzalez-Martin, Sepulcre, Molina-Masegosa and Gozalvez (IEEE TVT 68(2),
2019): 10 MHz at 5.9 GHz, packets of 190 bytes in sub-channels of a 1 ms subframe, WINNER+ B1 with
an effective antenna height of 1.5 m, block errors of 3GPP R1-160284. They validated it by
simulation at 100 to 300 vehicles a kilometre, 10 and 20 Hz, 20 and 23 dBm, distances up to 500 m.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from harness.extensions.radio.block_error import BlockError, block_error
from harness.extensions.radio.propagation import noise_dbm
from harness.extensions.radio.sidelink import Sidelink

# Coding and resource blocks (of 50 in 10 MHz) of a packet, by number of sub-channels.
CODINGS = {4: ("lte-qpsk-0.7-190B", 10), 2: ("lte-qpsk-0.5-190B", 12)}


@dataclass(frozen=True)
class LteMode4(Sidelink):
    """Model LTE-V2X Mode 4 in a 10 MHz channel, where vehicles choose resources by sensing.

    A resource is what one packet takes: a sub-channel, one of `subchannels` bands of frequency, in
    a slot of 1 ms. Vehicles rank those that they have not sensed as taken by received power, and
    choose among the weakest. Other settings are those of `Sidelink`, which it shares with NR Mode
    2.
    """

    # packets beside each other in a subframe, and with them the coding: 4 of QPSK at rate 0.7, or 2
    # at 0.5
    subchannels: Literal[2, 4] = 4
    # that free resources are ranked by received power
    ranks: ClassVar[bool] = True

    @property
    def slot_s(self) -> float:
        return 0.001

    @property
    def blocks_per_slot(self) -> int:
        return self.subchannels

    @property
    def block_bits(self) -> int:
        return 190 * 8

    @property
    def noise_dbm(self) -> float:
        return noise_dbm(10e6 * CODINGS[self.subchannels][1] / 50, self.noise_figure_db)

    @property
    def block_error(self) -> BlockError:
        return block_error(CODINGS[self.subchannels][0])
