"""Radio propagation: path loss, blockage, shadowing and noise.

Sources: 3GPP TR 37.885 (tables 6.2-1, 6.2.1-1 and 6.2.1-2) for highway and urban links, WINNER+
D5.3 B1 as Gonzalez-Martin et al. (IEEE TVT 68(2), 2019) use it, and Mangel, Klemp and Hartenstein
(EURASIP JWCN 2011:182), as Abbas et al. (2015, equation 6) print it, for links round a corner.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.config import between
from harness.core.quantiles import normal_share
from harness.radio.channel import CLEAR, VEHICLE

Environment = Literal["winner-b1", "tr37885-highway", "tr37885-urban"]

LIGHT_M_PER_S = 3e8
# no formula here is valid below this distance; a shorter link has the loss of this distance
NEAREST_M = 3.0


@dataclass(frozen=True)
class Propagation:
    """Define how strongly signals are received: path loss, blockage, shadowing.

    Blockage is the further loss behind a vehicle, and shadowing the slow change of power by what
    stands around. Fields are settings of a radio: `environment` names the laws of path loss,
    `frequency_ghz` is the carrier's, `antenna_m` the height of every antenna,
    `environment_height_m` what is taken off it, and `blocker_m` the height of a blocking vehicle.
    Round a corner, `street_m` is the width of the receiver's street, `wall_m` the sender's distance
    from its wall, and `suburban` a further loss.
    """

    # law of links without a building between, with its LOS probabilities and decorrelation
    environment: Environment = "winner-b1"
    frequency_ghz: Annotated[float, between(0.1, 100)] = 5.91  # carrier frequency
    antenna_m: Annotated[float, between(0, 100)] = 1.5  # height of every antenna
    # average height of the vehicles' surroundings, for `winner-b1` only. The effective antenna
    # height is `antenna_m` less this: 1.5 m with 0 (Gonzalez-Martin et al.), 0.5 m with 1 (TR
    # 36.885), 12 dB more at 100 m
    environment_height_m: Annotated[float, between(0, 100)] = 0.0
    # height of a blocking vehicle if no scene gives it: 1.6 m is a car, 3.0 m a lorry (TR 37.885,
    # 6.1.2)
    blocker_m: Annotated[float, between(0, 100)] = 1.6
    # width of the receiver's street, in the law of the corner
    street_m: Annotated[float, between(0.1, 1000)] = 14.0
    # distance of the transmitter from its wall, in the law of the corner
    wall_m: Annotated[float, between(0.1, 1000)] = 7.0
    suburban: bool = False  # adds 2.94 dB round a corner

    def path_loss_db(
        self,
        distance_m: Floats,
        sight: Ints | int = CLEAR,
        blocker_m: Floats | float | None = None,
        corner_m: Floats | None = None,
        first_m: float | None = None,
    ) -> Floats:
        """Return the mean path loss `(...)` of links, dB, blockage by a vehicle included.

        Path loss is how much weaker a signal is received than sent.

        Args:
            distance_m: distance between the ends, m, `(...)`.
            sight: what stands between: `CLEAR`, `VEHICLE` or `BUILDING`, `(...)`.
            blocker_m: height of a vehicle between, m; None for the setting of that name.
            corner_m: distances of both ends to the crossing's centre, m, `(..., 2)`; NaN if a
                building between is not at a corner, for which the NLOS law of TR 37.885 holds.
            first_m: height of one antenna, m, if it is not `antenna_m`.
        """
        distance_m = np.maximum(distance_m, NEAREST_M)
        clear_db = self.clear_db(distance_m, first_m)
        if np.ndim(sight) == 0 and sight == CLEAR:
            return clear_db
        blocked_db = self.blockage_db(distance_m, blocker_m, first_m)[0]
        behind_db = nlos_db(distance_m, self.frequency_ghz)
        if corner_m is not None:
            round_db = self.corner_db(corner_m, first_m)
            behind_db = np.where(np.isnan(round_db), behind_db, round_db)
        return np.select(
            [np.equal(sight, CLEAR), np.equal(sight, VEHICLE)],
            [clear_db, clear_db + blocked_db],
            # Close to the corner the fitted law would fall below that of the open street.
            np.maximum(behind_db, clear_db),
        )

    def clear_db(self, distance_m: Floats, first_m: float | None = None) -> Floats:
        """Return the path loss `(...)` in line of sight, dB, at distances `(...)`, m.

        `first_m` is the height of one antenna, m, if it is not `antenna_m`.
        """
        if self.environment == "winner-b1":
            effective_m = self._mean_height_m(first_m, self.environment_height_m)
            return winner_b1_db(distance_m, self.frequency_ghz, effective_m)
        if self.environment == "tr37885-highway":
            return 32.4 + 20 * np.log10(distance_m) + 20 * math.log10(self.frequency_ghz)
        return 38.77 + 16.7 * np.log10(distance_m) + 18.2 * math.log10(self.frequency_ghz)

    def _mean_height_m(self, first_m: float | None, less_m: float = 0.0) -> float:
        """Return the geometric mean of both antennas' heights above `less_m`,
        as in two-ray propagation.
        """
        heights_m = (self.antenna_m, self.antenna_m if first_m is None else first_m)
        one_m, other_m = (max(height - less_m, 0.1) for height in heights_m)
        return one_m if first_m is None else math.sqrt(one_m * other_m)

    def blockage_db(
        self,
        distance_m: Floats,
        blocker_m: Floats | float | None = None,
        first_m: float | None = None,
    ) -> tuple[Floats, Floats]:
        """Return mean and standard deviation, `(...)`, of a blocking vehicle's additional loss, dB.

        `blocker_m` is its height, None for the model's own, and `first_m` the height of one
        antenna, if it is not `antenna_m`. By TR 37.885, 6.2.1, the loss is max(0, X) with X normal
        in dB: mean 9 and deviation 4.5 if both antennas are lower than the blocker, 5 and 4 if only
        one is. There is none if both are higher. Beyond 541 m the mean grows by 15 log10 d - 41.
        """
        blocker_m = self.blocker_m if blocker_m is None else blocker_m
        other_m = self.antenna_m if first_m is None else first_m
        low_m, high_m = sorted((self.antenna_m, other_m))
        # 1, 0 or -1
        higher = np.greater(blocker_m, high_m).astype(np.int64) - np.less(blocker_m, low_m)
        mean_db, deviation_db = np.array(_BLOCKAGE_DB).T
        growth_db = np.maximum(0.0, 15 * np.log10(np.maximum(distance_m, NEAREST_M)) - 41)
        return np.where(higher < 0, 0.0, mean_db[higher] + growth_db), deviation_db[higher]

    def corner_db(self, corner_m: Floats, first_m: float | None = None) -> Floats:
        """Return the path loss `(...)` round a corner, dB (Mangel et al.).

        `corner_m` are the distances of both ends to the crossing's centre, m, `(..., 2)`, and
        `first_m` is the height of one antenna, m, if it is not `antenna_m`. The law is not quite
        reciprocal, but a radio link is, so the mean of both directions in dB is taken.
        """
        one_m, other_m = np.moveaxis(np.maximum(corner_m, NEAREST_M), -1, 0)
        height_m = self._mean_height_m(first_m)
        there_db = self._corner_one_way_db(one_m, other_m, height_m)
        return 0.5 * (there_db + self._corner_one_way_db(other_m, one_m, height_m))

    def _corner_one_way_db(
        self, transmitter_m: Floats, receiver_m: Floats, height_m: float
    ) -> Floats:
        # The breakpoint is that of the two-ray model; Abbas et al. use the same symbol for it.
        wave_m = LIGHT_M_PER_S / (self.frequency_ghz * 1e9)
        break_m = 4 * height_m**2 / wave_m
        spread: Floats = transmitter_m**0.957 / (self.wall_m * self.street_m) ** 0.81
        ratio = spread * 4 * np.pi * receiver_m / wave_m * np.maximum(1.0, receiver_m / break_m)
        return 3.75 + 2.94 * self.suburban + 26.9 * np.log10(ratio)

    def shadowing_db(
        self,
        sight: Ints | int = CLEAR,
        blocker_m: Floats | float | None = None,
        corner_m: Floats | None = None,
        first_m: float | None = None,
    ) -> Floats:
        """Return the standard deviation `(...)` of shadowing and blockage together, dB.

        Shadowing is the slow change of received power by what stands around; blockage is a vehicle
        between. It is 3 dB in line of sight, with the blockage's own deviation behind a vehicle, 4
        dB behind a building (TR 37.885, table 6.2.1-1; WINNER+ B1 has the same 3 and 4), 4.1 dB
        round a corner (Mangel et al.).

        Args:
            sight: what stands between: `CLEAR`, `VEHICLE` or `BUILDING`, `(...)`.
            blocker_m: height of a vehicle between, m; None for the setting of that name.
            corner_m: distances of both ends to the crossing's centre, m, `(..., 2)`; NaN if there
                is none.
            first_m: height of one antenna, m, if it is not `antenna_m`.
        """
        behind: Floats | float = 4.0
        if corner_m is not None:
            behind = np.where(np.isnan(corner_m).any(axis=-1), 4.0, 4.1)
        vehicle_db = np.hypot(3.0, self.blockage_db(np.array(NEAREST_M), blocker_m, first_m)[1])
        return np.select(
            [np.equal(sight, CLEAR), np.equal(sight, VEHICLE)], [3.0, vehicle_db], behind
        )

    @property
    def decorrelation_m(self) -> float:
        """Return over how many metres of driving a link's shadowing stays alike: correlation 1/e.

        Shadowing is the slow change of power by what stands around. It is 25 m on a highway, else
        10 m, by TR 37.885, 6.2.1, and by TR 36.885 for `winner-b1`. In a town TR 37.885 has 13 m
        for links without line of sight; here these have 10 m as well, so that shadowing does not
        jump when sight is lost.
        """
        return 25.0 if self.environment == "tr37885-highway" else 10.0

    def clear_probability(self, distance_m: Floats) -> Floats:
        """Return the share of links of these lengths, m, that no vehicle blocks, without buildings.

        `distance_m` is `(...)`, as is the result. It is that of TR 37.885, table 6.2-1. In
        `winner-b1` no link is blocked.
        """
        if self.environment == "winner-b1":
            return np.ones_like(distance_m)
        if self.environment == "tr37885-urban":
            return np.minimum(1.0, 1.05 * np.exp(-0.0114 * distance_m))
        near = np.minimum(1.0, 2.1013e-6 * distance_m**2 - 0.002 * distance_m + 1.0193)
        return np.where(distance_m <= 475, near, np.maximum(0.0, 0.54 - 0.001 * (distance_m - 475)))


def _clipped(mean: float, deviation: float) -> tuple[float, float]:
    """Return mean and standard deviation of max(0, X) for a normal X."""
    z = mean / deviation
    above, at = float(normal_share(z)), math.exp(-z * z / 2) / math.sqrt(2 * math.pi)
    first = mean * above + deviation * at
    return first, math.sqrt((mean**2 + deviation**2) * above + mean * deviation * at - first**2)


# Mean and deviation for a blocker between the antennas' heights, higher than both, and lower than
# both.
_BLOCKAGE_DB = [_clipped(5.0, 4.0), _clipped(9.0, 4.5), (0.0, 0.0)]


def winner_b1_db(distance_m: Floats, frequency_ghz: float, effective_m: float) -> Floats:
    """Return the path loss of WINNER+ B1 in line of sight, dB, at least that of free space.

    `distance_m` is `(...)`, as is the result, `frequency_ghz` the carrier frequency, and
    `effective_m` the effective antenna height, m.
    """
    far = distance_m >= 4 * effective_m**2 * frequency_ghz * 1e9 / LIGHT_M_PER_S
    log_m, log_ghz = np.log10(distance_m), math.log10(frequency_ghz)
    near_db = 22.7 * log_m + 27 + 20 * log_ghz
    far_db = 40 * log_m + 7.56 - 34.6 * math.log10(effective_m) + 2.7 * log_ghz
    free_db = 20 * log_m + 46.4 + 20 * math.log10(frequency_ghz / 5)
    return np.maximum(np.where(far, far_db, near_db), free_db)


def nlos_db(distance_m: Floats, frequency_ghz: float) -> Floats:
    """Return the path loss behind a building at distances in m, `(...)`, dB, `(...)`.

    It is that of TR 37.885, table 6.2.1-1, for the carrier frequency `frequency_ghz`.
    """
    return 36.85 + 30 * np.log10(distance_m) + 18.9 * math.log10(frequency_ghz)


def noise_dbm(bandwidth_hz: float, noise_figure_db: float) -> float:
    """Return the noise power, dBm, of a receiver at 290 K: -95 dBm in 10 MHz with a figure of 9 dB.

    `bandwidth_hz` is the width of what it receives, and `noise_figure_db` what its circuits add.
    """
    return -174 + 10 * math.log10(bandwidth_hz) + noise_figure_db
