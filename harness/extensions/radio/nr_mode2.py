"""NR-V2X Mode 2: vehicles choose their resources themselves,
from the control information they decoded.

The model of Mode 4 with slots for subframes and without ranking: a vehicle takes any resource that
it has not sensed as taken (TS 38.214, 8.1.4), which is Step 2 of that model alone. The chance that
two vehicles choose the same does not depend on the length of the selection window, if all have the
same (Brady, Cao and Roy, arXiv 2309.16680: the overlap of two windows cancels); the window is in
the delay alone. Re-evaluation shortly before sending is not modelled.

Defaults are those of 5G-LENA's highway example: 40 MHz at 5.89 GHz, numerology 0, MCS 14,
sub-channels of 50 resource blocks, packets of 200 bytes, window of slots 2 to 33, no resource kept.
What a receiver takes for a packet, and senses, is the control channel above `sensing_dbm`. All of
the transmit power goes into the resource blocks that are sent, so the power of a packet does not
depend on its width. The default threshold is Mode 4's; the profile `mode2` has that of the
simulations it is held against.
"""

import csv
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from harness.core.config import between
from harness.core.errors import UserError
from harness.core.files import text_of
from harness.extensions.radio.block_error import BlockError, block_error, threshold
from harness.extensions.radio.propagation import Environment, noise_dbm
from harness.extensions.radio.sidelink import Sidelink

# Resource blocks by bandwidth in MHz, for subcarriers of 15, 30 and 60 kHz (TS 38.101-1, table
# 5.3.2-1).
BLOCKS = {10: (52, 24, 11), 20: (106, 51, 24), 30: (160, 78, 38), 40: (216, 106, 51)}

# Resource elements with reference signals, of 12 subcarriers in 13 symbols, by numerology
# (WiLabV2Xsim's).
REFERENCES = (24, 18, 12)

CURVES = {7: "nr-mcs7-100B-urban-nlos", 21: "nr-mcs21-1500B-urban-nlos"}


@dataclass(frozen=True)
class NrMode2(Sidelink):
    """Model NR-V2X Mode 2 in one resource pool, where vehicles choose resources by sensing.

    A resource is one or more sub-channels, each `subchannel_blocks` resource blocks (of frequency)
    wide, in one slot: what one packet takes. Fields are settings, with those of `Sidelink`,
    `Transceiver` and `Propagation`: `environment` names the law of path loss, and the channel has
    `bandwidth_mhz` around the carrier `frequency_ghz`. Other vehicles' packets have `packet_bytes`.
    A packet may be sent from slot `t1_slots` to `t2_slots` after it is ready; `numerology` 0, 1 or
    2 has slots of 1, 0.5 or 0.25 ms, `mcs` is the modulation and coding, and `efficiency` the share
    of Shannon's bound that codings without a curve reach.
    """

    # law of links without a building between; see `Propagation`
    environment: Environment = "tr37885-highway"
    frequency_ghz: Annotated[float, between(0.1, 100)] = 5.89  # carrier frequency
    # first slot, counted from when a message is ready, in which it may be sent
    t1_slots: Annotated[int, between(0, 10000)] = 2
    t2_slots: Annotated[int, between(0, 10000)] = 33  # the last one
    bandwidth_mhz: Literal[10, 20, 30, 40] = 40  # width of the channel
    # 0, 1 or 2: slots of 1, 0.5 or 0.25 ms, subcarriers of 15, 30 or 60 kHz
    numerology: Literal[0, 1, 2] = 0
    # resource blocks of a sub-channel. A packet takes as many of these as it needs
    subchannel_blocks: Annotated[int, between(10, 100)] = 50
    # modulation and coding, 0 to 28 (TS 38.214, table 5.1.3.1-1). 7 and 21 have curves of block
    # error, the others a threshold of SINR
    mcs: Annotated[int, between(0, 28)] = 14
    packet_bytes: Annotated[int, between(1, 10000)] = 200  # size of a background packet
    # share of Shannon's bound that codings without a curve reach (`block_error.threshold`). 0.4 is
    # WiLabV2Xsim's for moving vehicles, 0.62 that of MCS 14 in 5G-LENA's tables without fading:
    # half of the blocks are lost at 10.1 dB
    efficiency: Annotated[float, between(0.1, 1)] = 0.4
    ranks: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blocks_per_slot < 1:
            raise UserError(
                f"a packet of {self.packet_bytes} bytes needs {self._subchannels} sub-channels of "
                f"{self.subchannel_blocks} resource blocks, and {self.bandwidth_mhz} MHz have "
                f"{BLOCKS[self.bandwidth_mhz][self.numerology]} blocks: raise bandwidth_mhz or mcs"
            )

    @property
    def slot_s(self) -> float:
        return 0.001 / 2**self.numerology

    @property
    def blocks_per_slot(self) -> int:
        return (
            BLOCKS[self.bandwidth_mhz][self.numerology]
            // self.subchannel_blocks
            // self._subchannels
        )

    @property
    def block_bits(self) -> int:
        """Return how many bits fit into one block, the sub-channels of a background packet.

        A sub-channel is a band of frequency; background packets are those of other vehicles.
        """
        return int(self._subchannels * self._subchannel_bits)

    @property
    def noise_dbm(self) -> float:
        width_hz = 180e3 * 2**self.numerology * self.subchannel_blocks * self._subchannels
        return noise_dbm(width_hz, self.noise_figure_db)

    @property
    def block_error(self) -> BlockError:
        if self.mcs in CURVES:
            return block_error(CURVES[self.mcs])
        return threshold(_bits_per_s_per_hz()[self.mcs], self.efficiency)

    @property
    def _subchannel_bits(self) -> float:
        data = 12 * 13 - REFERENCES[self.numerology]
        return self.subchannel_blocks * data * _bits_per_s_per_hz()[self.mcs]

    @property
    def _subchannels(self) -> int:
        return math.ceil(8 * self.packet_bytes / self._subchannel_bits)


@cache
def _bits_per_s_per_hz() -> list[float]:
    text = text_of(Path(__file__).with_name("nr_mcs.csv"))
    rows = csv.DictReader(text.splitlines())
    return [int(row["bits_per_symbol"]) * int(row["rate_1024"]) / 1024 for row in rows]
