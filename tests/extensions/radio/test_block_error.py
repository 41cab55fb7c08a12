"""Block error curves: the points of their sources, between them, and beyond the ends."""

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.extensions.radio.block_error import block_error, threshold


def test_points_are_joined_and_held():
    lost = block_error("lte-qpsk-0.7-190B")
    np.testing.assert_allclose(
        lost(np.array([-5.0, 0, 3, 8, 15, 40])), [1, 1, 0.8, 0.13, 0.004, 0.001], rtol=1e-12
    )
    np.testing.assert_allclose(block_error("lte-qpsk-0.5-190B")(np.array([1.0, 4])), [0.8, 0.3])


@pytest.mark.parametrize(
    ("curve", "ten_percent_db"),
    [
        ("lte-mcs7-350B-highway-los", 4.1),
        ("lte-mcs7-350B-crossing-nlos", 6.9),
        ("lte-mcs3-190B-highway-los", -0.5),
        ("nr-mcs7-100B-urban-nlos", 13.7),
        ("nr-mcs21-1500B-urban-nlos", 26.8),
        ("11p-mcs2-350B-crossing-nlos", 5.9),
        ("11p-mcs4-350B-crossing-nlos", 12.6),
    ],
)
def test_fits_lose_ten_percent_where_their_source_does(curve, ten_percent_db):
    lost = block_error(curve)
    levels = np.arange(-5, 35, 0.01)
    assert levels[np.argmax(lost(levels) <= 0.1)] == pytest.approx(ten_percent_db, abs=0.2)
    assert np.all(np.diff(lost(levels)) <= 0)


def test_other_codings_have_a_threshold():
    # 1.03 bit/s/Hz at 40 % of Shannon's bound: 2^2.575 - 1 = 4.96, 6.95 dB.
    lost = threshold(1.03, 0.4)
    assert lost(np.array([6.9, 7.0])).tolist() == [1.0, 0.0]


def test_an_unknown_curve_is_refused_in_one_line():
    with pytest.raises(UserError, match="'lte-mcs8' is unknown: use one of 11p-goubet"):
        block_error("lte-mcs8")
