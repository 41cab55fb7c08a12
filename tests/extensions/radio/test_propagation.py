"""What a signal loses: played by hand against the sources' equations,
with the figures they are known by.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.extensions.radio.propagation import Propagation, noise_dbm
from harness.radio.channel import BUILDING, CLEAR, VEHICLE

HIGHWAY = Propagation(environment="tr37885-highway", frequency_ghz=5.9)
URBAN = Propagation(environment="tr37885-urban", frequency_ghz=5.9)
WINNER = Propagation()


def at(law, metres, sight=CLEAR, corner_m=None):
    corner = None if corner_m is None else np.array(corner_m, float)
    return float(law.path_loss_db(np.array(metres, float), np.array(sight), None, corner))


def test_path_loss_by_hand():
    assert at(HIGHWAY, 100) == pytest.approx(32.4 + 40 + 20 * np.log10(5.9))
    assert at(URBAN, 100) == pytest.approx(38.77 + 33.4 + 18.2 * np.log10(5.9))
    assert at(URBAN, 100, BUILDING) == pytest.approx(36.85 + 60 + 18.9 * np.log10(5.9))
    # Breakpoint 4 * 1.5 m * 1.5 m * 5.91 GHz / c = 177.3 m.
    assert at(WINNER, 177) == pytest.approx(22.7 * np.log10(177) + 27 + 20 * np.log10(5.91))
    assert at(WINNER, 178) == pytest.approx(
        40 * np.log10(178) + 7.56 - 34.6 * np.log10(1.5) + 2.7 * np.log10(5.91)
    )
    assert at(WINNER, 0.5) == at(WINNER, 3)


def test_the_effective_height_of_winner_b1_is_worth_twelve_db_at_100_m():
    assert at(WINNER, 100) == pytest.approx(87.85, abs=0.01)
    assert at(replace(WINNER, environment_height_m=1.0), 100) == pytest.approx(100.0, abs=0.1)


def test_winner_b1_is_never_below_free_space():
    # Close in, free space would lose more than the street's law: 20 log10 3 + 46.4 + 1.45 dB.
    assert at(WINNER, 3) == pytest.approx(20 * np.log10(3) + 46.4 + 20 * np.log10(5.91 / 5))


def test_snr_at_50_m():
    """23 dBm and 6 dBi in 10 MHz: 42 dB in line of sight and 21.6 dB behind a building."""
    noise = noise_dbm(10e6, 9.0)
    assert noise == pytest.approx(-95.0)
    assert 29 - at(HIGHWAY, 50) - noise == pytest.approx(42.2, abs=0.05)
    assert 29 - at(URBAN, 50, BUILDING) - noise == pytest.approx(21.6, abs=0.05)


def test_round_the_corner():
    """93.2 dB at 20 m from the crossing, 114.2 dB at 50 m;
    TR 37.885's NLOS law has 95.0 and 106.9.
    """
    for metres, corner, nlos in ((20, 93.2, 95.0), (50, 114.2, 106.9)):
        straight = metres * np.sqrt(2)
        assert at(URBAN, straight, BUILDING, [metres, metres]) == pytest.approx(corner, abs=0.06)
        assert at(URBAN, straight, BUILDING, [np.nan, np.nan]) == pytest.approx(nlos, abs=0.06)


def test_a_corner_is_reciprocal_and_falls_off_faster_beyond_the_breakpoint():
    assert at(URBAN, 60, BUILDING, [20, 50]) == pytest.approx(at(URBAN, 60, BUILDING, [50, 20]))
    near, far = (at(URBAN, d, BUILDING, [20, d]) for d in (200, 400))
    # Beyond the breakpoint the far end counts squared as receiver, and with the power 0.957 as
    # transmitter.
    assert far - near == pytest.approx(26.9 * (2 + 0.957) / 2 * np.log10(2))


def test_at_the_corner_itself_the_street_s_own_law_holds():
    assert at(URBAN, 4, BUILDING, [3, 3]) == at(URBAN, 4)


@pytest.mark.parametrize(
    ("antenna_m", "mean_db", "deviation_db"),
    [(1.5, 9.0, 4.5), (1.6, 5.0, 4.0), (1.7, -np.inf, 1.0)],
)
def test_a_vehicle_between_adds_the_clipped_normal_of_its_heights(antenna_m, mean_db, deviation_db):
    law = replace(URBAN, antenna_m=antenna_m)
    drawn = np.maximum(
        0, np.random.default_rng(0).normal(max(mean_db, -1e9), deviation_db, 400_000)
    )
    added = at(law, 100, VEHICLE) - at(law, 100)
    assert added == pytest.approx(drawn.mean(), abs=0.03)
    assert law.shadowing_db(VEHICLE) == pytest.approx(np.hypot(3, drawn.std()), abs=0.03)
    if antenna_m < law.blocker_m:
        grown = at(law, 1000, VEHICLE) - at(law, 1000)
        assert grown == pytest.approx(added + 4)


def test_each_link_has_the_vehicle_that_stands_in_it():
    heights, sight = np.array([1.4, 1.5, 3.0, 0.0]), np.array([VEHICLE, VEHICLE, VEHICLE, CLEAR])
    added = URBAN.path_loss_db(np.full(4, 50.0), sight, heights) - at(URBAN, 50)
    np.testing.assert_allclose(added, [0, 5.20, 9.04, 0], atol=0.01)
    np.testing.assert_allclose(URBAN.shadowing_db(sight, heights)[[0, 3]], 3.0)


def test_shadowing():
    corner = np.array([[20.0, 20.0], [np.nan, np.nan]])
    np.testing.assert_allclose(
        URBAN.shadowing_db(np.array([BUILDING, BUILDING]), None, corner), [4.1, 4.0]
    )
    assert float(URBAN.shadowing_db()) == 3.0
    assert [law.decorrelation_m for law in (HIGHWAY, URBAN, WINNER)] == [25, 10, 10]


def test_share_of_clear_links():
    far = np.array([0.0, 100.0, 475.0, 600.0, 1200.0])
    np.testing.assert_allclose(WINNER.clear_probability(far), 1.0)
    np.testing.assert_allclose(URBAN.clear_probability(far)[:2], [1.0, 1.05 * np.exp(-1.14)])
    np.testing.assert_allclose(
        HIGHWAY.clear_probability(far),
        [1.0, 0.021013 - 0.2 + 1.0193, 0.5434, 0.415, 0.0],
        atol=1e-3,
    )


@given(
    law=st.sampled_from([HIGHWAY, URBAN, WINNER]),
    sight=st.sampled_from([CLEAR, VEHICLE, BUILDING]),
    metres=st.floats(1, 1000),
    further=st.floats(1, 3),
)
def test_further_is_never_louder_and_what_stands_between_never_helps(law, sight, metres, further):
    assert at(law, metres * further, sight) >= at(law, metres, sight) - 1e-9
    assert at(law, metres, sight) >= at(law, metres)
