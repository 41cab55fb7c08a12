"""Block error rates over the signal-to-interference-and-noise ratio (SINR),
by modulation and coding.

Every curve already includes fast fading, so a model adds none. `block_error_points.csv` has points
read off 3GPP R1-160284 (190 bytes, 280 km/h, vehicles on a highway), and those of Goubet et al.
(IEEE TVT 64(9), 2015, figure 14, L = 1) as Sepulcre et al. use them, over the energy of a bit
(`its_g5`). `block_error_fits.csv` has logistic curves that were fitted to the tables of packet
error that come with WiLabV2Xsim (root mean square error 0.012 at most); a name says technology,
modulation and coding, size and surroundings.
"""

import csv
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.files import text_of
from harness.core.quantiles import logistic

# Maps SINR in dB to the probability that a block is lost, of the same shape.
BlockError = Callable[[Floats], Floats]


@cache
def block_error(curve: str) -> BlockError:
    """Return a published curve by its name, such as `11p-goubet`: the loss of blocks by their SINR.

    A block is what is coded and sent as one. The curve is a function: it takes an array of
    signal-to-interference-and-noise ratios in dB and returns the probabilities, of the same shape,
    that a block is lost. Points are interpolated linearly, and the end values hold beyond them.
    Raises UserError for an unknown name.
    """
    points = [row for row in _rows("block_error_points.csv") if row["curve"] == curve]
    if points:
        snr_db = [float(row["snr_db"]) for row in points]
        lost = [float(row["block_error"]) for row in points]
        return lambda sinr_db: np.interp(sinr_db, snr_db, lost)
    fits = {row["curve"]: row for row in _rows("block_error_fits.csv")}
    if curve not in fits:
        names = sorted({row["curve"] for row in _rows("block_error_points.csv")} | set(fits))
        raise UserError(f"block error curve {curve!r} is unknown: use one of {', '.join(names)}")
    middle, slope = (float(fits[curve][key]) for key in ("midpoint_db", "slope_per_db"))
    return lambda sinr_db: logistic(slope * (middle - sinr_db))


def threshold(bits_per_s_per_hz: float, efficiency: float) -> BlockError:
    """Return a step function from SINR in dB to block error rate, 1 below a threshold and 0 above.

    Blocks are lost below the SINR 2^(`bits_per_s_per_hz` / `efficiency`) - 1. The first is the
    coding's data rate by bandwidth, the second the share of Shannon's bound that an implementation
    reaches: 0.37 for LTE and 802.11p, 0.4 for NR. It is for codings without a curve (Wu et al.,
    arXiv 2203.17114).
    """
    least_db = 10 * np.log10(2 ** (bits_per_s_per_hz / efficiency) - 1)
    return lambda sinr_db: np.where(sinr_db < least_db, 1.0, 0.0)


@cache
def _rows(name: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text_of(Path(__file__).with_name(name)).splitlines()))
