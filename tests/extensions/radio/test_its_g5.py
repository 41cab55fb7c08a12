"""802.11p: airtimes and waits by hand, closed forms beside a simulation of the slots,
published curves.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from tiers import some

from harness.core.errors import UserError
from harness.extensions.radio import back_off
from harness.extensions.radio.back_off import SLOT_S
from harness.extensions.radio.its_g5 import ItsG5
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Channel, Draws, Links, Site
from harness.radio.fading import Trips

QUIET = ItsG5(density_per_km=0)
CROWD = ItsG5(density_per_km=120, rate_hz=25)
NEAR_M = np.arange(0.0, 500.0, 12.5)
EVENLY = (np.arange(20_000) + 0.5) / 20_000


def site(distance_m, sight=CLEAR, corner_m=np.nan) -> Site:
    distance_m = np.atleast_1d(np.asarray(distance_m, dtype=float))
    there = np.stack([np.append(0.0, distance_m), np.zeros(1 + distance_m.size)], axis=-1)
    n = distance_m.size
    return Site(there, np.full(n, sight), np.full(n, 1.6), np.full((n, 2), corner_m))


# -- by hand ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("size_bytes", "airtime_us"), [(190, 304), (300, 448), (350, 512)])
def test_a_frame_is_a_preamble_and_whole_symbols_of_48_bits_at_6_mbps(size_bytes, airtime_us):
    """190 bytes: 1 542 bits with service and tail, 33 symbols of 8 µs behind 40 µs."""
    assert QUIET.airtime_s(size_bytes) == pytest.approx(airtime_us * 1e-6)


def test_a_message_carries_the_headers_of_the_layers_below():
    assert QUIET.message_s(8 * 160) == pytest.approx(304e-6)
    assert QUIET.packet_s == QUIET.airtime_s(220)


def test_on_an_idle_medium_one_waits_an_aifs_and_half_the_window_and_nothing_collides():
    """110 µs, and 0 to 15 slots of 13 µs, all equally likely: 97.5 µs on average."""
    assert QUIET.aifs_s == pytest.approx(110e-6)
    assert back_off.mean_access_s(0.0, 3e-4, QUIET.aifs_s, 15) == pytest.approx(207.5e-6)
    waits_s = QUIET.wait_s(EVENLY)
    assert waits_s.mean() == pytest.approx(207.5e-6, abs=1e-6)
    assert sorted(set(np.round((waits_s - 110e-6) / SLOT_S, 0))) == list(range(16))
    assert QUIET.busy_ratio() == 0
    assert back_off.crowding(0.0, 3e-4, 110e-6, 15) == 1
    # 3 m apart the energy of a bit is 58 dB over the noise: the source's curve leaves 0.1 %.
    assert QUIET.loss(site(3), np.zeros(1), 800.0) == pytest.approx(0.001)


def test_a_link_by_hand_with_nobody_else():
    """150 m: 40 log10 d + 7.56 + 2.7 log10 5.89 = 96.68 dB, -73.68 dBm, 21.32 dB over noise,
    23.54 a bit.

    On the line from 20 dB (0.4 %) to 25 dB (0.3 %).
    Five standard deviations of 3 dB lower it is not sensed.
    """
    loss = QUIET.loss(site([150, 150]), np.array([0.0, -5.0]), 800.0)
    assert loss[0] == pytest.approx(0.004 - 0.001 * 3.54 / 5, abs=1e-5)
    assert loss[1] == 1


@pytest.mark.parametrize(
    ("curve", "half_db"),
    [("11p-mcs2-350B-highway-los", 1.08), ("11p-mcs4-350B-crossing-nlos", 10.39)],
)
def test_other_block_error_curves_hold_at_the_rate_that_they_were_made_for_and_shifted_at_others(
    curve, half_db
):
    rate = 6.0 if "mcs2" in curve else 12.0
    radio = ItsG5(curve=curve, data_rate_mbps=rate)
    assert radio.lost_share(np.array([half_db])) == pytest.approx(0.5)
    other = replace(radio, data_rate_mbps=18.0 - rate)
    # 2^(0.6/0.37) - 1 is 3.17 dB, 2^(1.2/0.37) - 1 is 9.28 dB.
    assert other.lost_share(np.array([half_db + math.copysign(6.11, 9.0 - rate)])) == pytest.approx(
        0.5, abs=0.01
    )


# -- limits and directions -------------------------------------------------------------------------


def test_reception_is_the_mean_of_what_links_have_over_their_shadowing():
    shadow = np.random.default_rng(0).standard_normal(40_000)
    for distance_m in (60.0, 250.0):
        there = np.broadcast_to([[0.0, 0.0], [distance_m, 0.0]], (40_000, 2, 2))
        clear = np.zeros((40_000, 1), dtype=int)
        links = Site(there, clear, clear, np.full((40_000, 1, 2), np.nan))
        bits = 8.0 * CROWD.packet_bytes
        received = 1 - CROWD.loss(links, shadow[:, None], bits).mean()
        assert received == pytest.approx(CROWD.reception(np.array([distance_m]))[0], abs=0.006)


def test_farther_denser_and_oftener_is_never_better():
    for radio in (QUIET, ItsG5(), CROWD):
        assert np.all(np.diff(radio.reception(NEAR_M)) <= 1e-9)
    for more in ({"density_per_km": 90.0}, {"rate_hz": 20.0}, {"packet_bytes": 500}):
        assert np.all(replace(ItsG5(), **more).reception(NEAR_M) <= ItsG5().reception(NEAR_M))
        assert replace(ItsG5(), **more).busy_ratio() > ItsG5().busy_ratio()
    longer = CROWD.loss(site(100.0), np.zeros(1), np.array([800.0, 8000.0]))
    assert longer[0] < longer[1]
    assert CROWD.wait_s(EVENLY).mean() > ItsG5().wait_s(EVENLY).mean() > QUIET.wait_s(EVENLY).mean()


def test_what_stands_between_costs_reception():
    clear, vehicle, building = (
        CROWD.reception(np.array([80.0, 160.0]), np.full(2, sight))
        for sight in (CLEAR, VEHICLE, BUILDING)
    )
    assert np.all(clear > vehicle)
    assert np.all(vehicle > building)
    # 50 m from the crossing on both streets: 114 dB, -91 dBm, below what is sensed.
    assert CROWD.loss(site(70.7, BUILDING, 50.0), np.zeros(1), 800.0) == 1
    assert CROWD.loss(site(28.3, BUILDING, 20.0), np.zeros(1), 800.0) < 0.5


# -- the closed forms beside a simulation of the slots ---------------------------------------------


def simulated(
    vehicles: int, packet: int, aifs: int, window: int, slots: int, seed: int
) -> tuple[float, float, float]:
    """Share of packets that begin with another, mean access delay in s, and busy ratio.

    Vehicles that all hear each other want to send ten times a second each, at random.
    """
    rng = np.random.default_rng(seed)
    n = rng.poisson(vehicles * 10 * SLOT_S * slots)
    at, who = np.sort(rng.integers(0, slots, n)), rng.integers(0, vehicles, n)
    count, idle, since = np.full(vehicles, -1), np.zeros(vehicles, int), np.zeros(vehicles, int)
    now = come = sent = met = busy = 0
    waited: list[int] = []

    def arrive(until: int) -> int:
        arrived = come
        while arrived < n and at[arrived] < until:
            vehicle = who[arrived]
            if count[vehicle] < 0:
                count[vehicle], since[vehicle], idle[vehicle] = (
                    rng.integers(0, window + 1),
                    at[arrived],
                    0,
                )
            arrived += 1
        return arrived

    while now < slots:
        come = arrive(now + 1)
        counts = (count >= 0) & (idle >= aifs)
        begins = counts & (count == 0)
        if begins.any():
            sent, met = sent + begins.sum(), met + begins.sum() * (begins.sum() > 1)
            waited += (now - since[begins]).tolist()
            count[begins], now, busy = -1, now + packet, busy + packet
            come = arrive(now)
            idle[:] = 0
        elif (count >= 0).any():
            count[counts] -= 1
            idle += 1
            now += 1
        else:
            now = max(now + 1, int(at[come]) if come < n else slots)
    return met / sent, float(np.mean(waited)) * SLOT_S, busy / slots


@pytest.mark.parametrize("vehicles", some([160], exhaustive=[40, 80, 120]))
def test_collisions_and_waits_are_those_of_simulated_slots(vehicles):
    """400 000 slots at busy ratios from .13 to .5, with packets of 25 slots behind an AIFS of 8."""
    runs = [simulated(vehicles, 25, 8, 15, 100_000, seed) for seed in range(4)]
    met, wait_s, busy = np.mean(runs, axis=0)
    per_slot = (vehicles - 1) * 10 * SLOT_S
    share, its_busy = back_off.same_slot(per_slot, 25, 8, 15)
    assert its_busy == pytest.approx(busy, rel=0.06)
    assert share == pytest.approx(met, rel=0.2, abs=0.002)
    assert back_off.mean_access_s(busy, 25 * SLOT_S, 8 * SLOT_S, 15) == pytest.approx(
        wait_s, rel=0.15
    )


@pytest.mark.parametrize("busy", [0.05, 0.3, 0.6])
def test_the_waits_drawn_have_the_mean_of_the_closed_form(busy):
    chances, wait_s = back_off.access(busy, 304e-6, 110e-6, 15)
    assert np.interp(EVENLY, chances, wait_s).mean() == pytest.approx(
        back_off.mean_access_s(busy, 304e-6, 110e-6, 15), rel=0.005
    )


# -- the seam --------------------------------------------------------------------------------------


def links_and_draws(n: int) -> tuple[Links, Draws]:
    rng = np.random.default_rng(n)
    where = Site(rng.uniform(0, 120, (n, 4, 2)), rng.integers(0, 3, (n, 3)), rng.choice([1.5, 3.6], (n, 3)),
                 rng.uniform(0, 60, (n, 3, 2)))  # fmt: skip
    asked = rng.random((n, 3)) < 0.8
    ready_s = np.where(asked, 0.145 + rng.uniform(0, 0.05, (n, 3)), np.nan)
    links = Links(
        asked,
        ready_s,
        rng.uniform(5, 90, (n, 3)),
        np.full((n, 3), 2400.0),
        asked,
        asked,
        800.0,
        where,
    )
    trips = Trips(np.zeros(n, int), np.arange(n), np.zeros(n, int), 6)
    return links, Draws(rng.random((n, 3, 2)), rng.random((n, 3)), trips)


def test_a_batch_is_one_at_a_time_and_who_was_not_asked_changes_nobody():
    assert isinstance(CROWD, Channel)
    links, draws = links_and_draws(200)
    up, delay_s, loss, airtime_s = CROWD.deliver(links, draws)
    assert np.array_equal(np.isfinite(delay_s), links.asked)
    assert np.all((delay_s > links.ready_s)[links.asked])
    assert np.all((loss >= 0) & (loss <= 1))
    assert airtime_s[0, 0] == CROWD.message_s(2400.0)
    assert 0.1 < up[links.asked].mean() < 0.95
    alone = CROWD.deliver(links.take(7), draws.take(7))
    for batch, single in zip((up, delay_s, loss, airtime_s), alone, strict=True):
        assert np.array_equal(batch[7], single, equal_nan=True)
    heard_s = np.asarray(CROWD.request(800.0, draws).heard_s)
    assert np.all(heard_s >= 110e-6 + CROWD.message_s(800.0) - 1e-6)


def test_replies_wait_for_each_other_and_those_that_begin_together_are_both_lost():
    """All ready at 150 ms on an idle medium;
    back-offs of 0, 0 and 10 slots, then of 0, 1 and 10.
    """
    where = Site(
        np.array([[0.0, 0], [20, 0], [0, 20], [20, 20]]),
        np.zeros(3, int),
        np.zeros(3),
        np.full((3, 2), np.nan),
    )
    asked, same = np.ones(3, bool), np.full(3, 0.15)
    links = Links(
        asked, same, np.array([20.0, 20.0, 28.0]), np.full(3, 1280.0), asked, asked, 800.0, where
    )

    def played(slots):
        draws = Draws(
            np.ones((3, 2)),
            (np.array(slots) + 0.5) / 16,
            Trips(np.array(0), np.array(0), np.array(0), 1),
        )
        object.__setattr__(draws, "packet", np.full((3, 2), 0.5))
        return QUIET.deliver(links, draws)

    together, apart = played([0, 0, 10]), played([0, 1, 10])
    assert together.up.tolist() == [False, False, True]
    assert apart.up.tolist() == [True, True, True]
    first_s = 0.15 + 110e-6 + 304e-6
    assert apart.delay_s == pytest.approx([first_s, first_s + 304e-6, first_s + 608e-6], abs=1e-6)


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ({"density_per_km": -1.0}, "density_per_km is -1.0: give a number from 0 to 10000"),
        ({"density_per_km": math.nan}, "density_per_km is nan: give"),
        (
            {"data_rate_mbps": 5.0},
            "its-g5: data_rate_mbps is 5.0; it must be one of 3, 4.5, 6, 9, 12, 18, 24, 27",
        ),
        (
            {"curve": "lte-mcs7-350B-urban-los"},
            "its-g5: curve is 'lte-mcs7-350B-urban-los'; it must be 11p-goubet or",
        ),
        ({"curve": "11p-mcs2-999B"}, "block error curve '11p-mcs2-999B' is unknown"),
        ({"antenna_m": 0.5}, "antenna_m is 0.5: give 0.6 or more"),
    ],
)
def test_settings_that_are_no_radio_are_refused(setting, says):
    with pytest.raises(UserError) as refused:
        ItsG5(**setting)
    assert says in str(refused.value)


def test_a_world_without_places_is_refused():
    one = np.ones(1)
    with pytest.raises(UserError, match="a physical radio needs vehicles that are somewhere"):
        ItsG5().deliver(
            Links(one > 0, one, one, one, one > 0, one > 0), Draws(np.ones((1, 2)), one)
        )
