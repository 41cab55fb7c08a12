"""LTE Mode 4: its factors against the equations, its collisions against a simulation,
and its limits.
"""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from tiers import some

from harness.core.errors import UserError
from harness.extensions.radio.block_error import block_error
from harness.extensions.radio.lte_mode4 import LteMode4
from harness.extensions.radio.nr_mode2 import NrMode2
from harness.extensions.radio.sps import Scheduling, taken
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Draws, Links, Site
from harness.radio.fading import Trips
from harness.radio.limits import outside
from harness.radio.profiles import CHANNELS

QUIET = LteMode4(density_per_km=0.0)
BUSY = LteMode4(density_per_km=200.0)
NR = NrMode2(density_per_km=200.0)
NOISE_DBM = -95 + 10 * np.log10(10 / 50)
LOST = block_error("lte-qpsk-0.7-190B")
RADIOS = BUSY, replace(BUSY, subchannels=2), replace(BUSY, environment="tr37885-urban"), NR


def place(distances_m, sight=CLEAR, corner_m=np.nan):
    """One ego and a helper at each of these distances, straight ahead."""
    distances_m = np.asarray(distances_m, float)
    xy_m = np.zeros((1 + len(distances_m), 2))
    xy_m[1:, 0] = distances_m
    return Site(
        xy_m=xy_m,
        sight=np.full(len(distances_m), sight),
        blocker_m=np.full(len(distances_m), 1.6 * (sight == VEHICLE)),
        corner_m=np.full((len(distances_m), 2), corner_m),
    )


def draws(n, helpers):
    trips = Trips(np.arange(n), np.zeros(n, int), np.zeros(n, int), steps=1)
    uniform = np.random.default_rng(0).random
    return Draws(uniform((n, helpers, 2)), uniform((n, helpers)), trips)


def links(site, n, helpers, payload_bits=800.0):
    shape = (n, helpers)

    def wide(array):
        return np.broadcast_to(array, (n, *array.shape))

    places = Site(wide(site.xy_m), wide(site.sight), wide(site.blocker_m), wide(site.corner_m))
    return Links(
        asked=np.ones(shape, bool), ready_s=np.full(shape, 0.1), range_m=np.full(shape, 50.0),
        payload_bits=np.full(shape, payload_bits), in_radius=np.ones(shape, bool),
        rounds=np.zeros(shape, bool), request_bits=400.0, site=places,
    )  # fmt: skip


@pytest.mark.parametrize("distance_m", [50.0, 250.0, 300.0, 400.0])
def test_without_others_it_is_half_duplex_sensing_and_noise(distance_m):
    # (7), (10) and (13): 10 packets a second of 1 ms each; N(Pt - PL, 3 dB) above -90.5 dBm; block
    # errors.
    mean = 23 - float(QUIET.path_loss_db(np.array(distance_m)))
    sensed = norm.sf(-90.5, mean, 3)
    power = np.arange(-90.5, -30, 1e-3)
    lost = np.trapezoid(norm.pdf(power, mean, 3) * LOST(power - NOISE_DBM), power)
    by_hand = (1 - 0.01) * sensed * (1 - lost / sensed)
    assert QUIET.reception(np.array([distance_m]))[0] == pytest.approx(by_hand, abs=1e-3)


def test_near_and_alone_only_half_duplex_and_the_curve_s_floor_remain():
    assert QUIET.loss(place([10]), np.zeros(1), 800.0)[0] == pytest.approx(1 - 0.99 * 0.999)
    assert QUIET.busy_ratio() == 0
    assert QUIET.reception(np.array([2000.0]))[0] < 1e-3


@pytest.mark.parametrize("distance_m", some([250.0], exhaustive=[100.0]))
def test_collisions_are_those_of_the_equations(distance_m):
    """(14) to (18), with every interferer's shadowing drawn instead of integrated."""
    rng = np.random.default_rng(1)
    scheduling = BUSY._scheduling()
    power = rng.normal(23 - float(BUSY.path_loss_db(np.array(distance_m))), 3, 4000)
    power = power[power >= -90.5]
    noise_lost = LOST(power - NOISE_DBM).mean()
    free = {scheduling.same_by_exclusion: 1.0, scheduling.same_by_ranking: 1.0}
    for place_m in np.concatenate([np.arange(-1000, 0, 5.0), np.arange(5, 1001, 5.0)]):
        mean = 23 - float(BUSY.path_loss_db(np.array(abs(place_m))))
        interference = 10 ** (rng.normal(mean, 3, power.size) / 10)
        lost = LOST(power - 10 * np.log10(interference + 10 ** (NOISE_DBM / 10))).mean()
        hit = max(0.0, (lost - noise_lost) / (1 - noise_lost))
        for same in free:
            free[same] *= 1 - float(same(np.array(abs(place_m + distance_m)))) * hit
    by_exclusion, by_ranking = free.values()
    weight = 2 * scheduling.busy_ratio - 0.4  # (22)
    collided = weight * (1 - by_exclusion) + (1 - weight) * (1 - by_ranking)  # (21)
    assert 0 < weight < 1
    expected = QUIET.reception(np.array([distance_m]))[0] * (1 - collided)
    assert BUSY.reception(np.array([distance_m]))[0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    "radio", [BUSY, replace(BUSY, transmissions=2), replace(BUSY, subchannels=2), NR]
)
@pytest.mark.parametrize("sight", [CLEAR, VEHICLE, BUILDING])
def test_loss_averaged_over_shadowing_is_the_curve(radio, sight):
    distances_m = np.array([20.0, 55, 100, 160, 250, 333, 450])
    shadows = norm.ppf((np.arange(4000) + 0.5) / 4000)
    site = links(place(distances_m, sight), len(shadows), len(distances_m)).where
    lost = radio.loss(site, np.tile(shadows[:, None], len(distances_m)), 1520.0)
    np.testing.assert_allclose(
        np.mean(1 - lost, axis=0), radio.reception(distances_m, sight), atol=2e-3
    )


def test_what_stands_between_and_the_corner_cost_reception():
    far = np.array([150.0])
    clear, vehicle, building = (
        BUSY.reception(far, sight)[0] for sight in (CLEAR, VEHICLE, BUILDING)
    )
    assert clear > vehicle > building
    assert BUSY.reception(np.full(2, 150.0), np.array([CLEAR, BUILDING])).tolist() == [
        clear,
        building,
    ]
    z = np.zeros(1)
    corner = BUSY.loss(place([80 * np.sqrt(2)], BUILDING, 80.0), z, 800.0)
    assert corner > BUSY.loss(place([80 * np.sqrt(2)], BUILDING), z, 800.0)
    # 50 m before the crossing, both: 114 dB, 5 dB below what is sensed without luck.
    assert QUIET.loss(place([50 * np.sqrt(2)], BUILDING, 50.0), z, 800.0)[0] == 1.0


@pytest.mark.exhaustive
@settings(deadline=None, max_examples=25)
@given(
    density=st.floats(0, 400),
    more=st.floats(1, 200),
    rate=st.sampled_from([5.0, 10.0, 20.0]),
    radio=st.sampled_from(RADIOS),
)
def test_more_load_never_helps_and_distance_never_helps(density, more, rate, radio):
    no_help(density, more, rate, radio)


@pytest.mark.parametrize("radio", RADIOS)
def test_twice_the_vehicles_never_help_and_distance_never_helps(radio):
    no_help(density=90.0, more=90.0, rate=10.0, radio=radio)


def no_help(density, more, rate, radio):
    distances_m = np.arange(20.0, 600, 40)
    light, heavy = (
        replace(radio, density_per_km=d, rate_hz=rate) for d in (density, density + more)
    )
    received = light.reception(distances_m)
    assert np.all(np.diff(received) <= 2e-3)
    # The evenly spaced interferers of two densities stand elsewhere: ripples of a point. In a town
    # the source's mixture of two ways to choose a resource lets more load help, by 3.3 points at
    # most.
    most = 0.035 if radio.environment == "tr37885-urban" else 0.02
    assert np.all(heavy.reception(distances_m) <= received + most)
    assert heavy.busy_ratio() >= light.busy_ratio()


def test_alone_more_power_never_hurts():
    distances_m = np.arange(20.0, 600, 20)
    received = [replace(QUIET, power_dbm=p).reception(distances_m) for p in (10.0, 17, 20, 23, 33)]
    assert np.all(np.diff(received, axis=0) >= -1e-9)


@pytest.mark.slow
def test_a_message_waits_for_a_slot_and_takes_one_a_block():
    n = 20_000
    given_draws = draws(n, 1)
    asked = BUSY.request(400.0, given_draws)
    assert asked.airtime_s == pytest.approx(0.001)
    # Uniform over the subframes 1 to 100: 50.5 ms, and the subframe itself.
    assert np.min(asked.heard_s) == pytest.approx(0.002)
    assert np.max(asked.heard_s) == pytest.approx(0.101)
    assert np.mean(asked.heard_s) == pytest.approx(0.0515, abs=4e-4)
    delivery = BUSY.deliver(links(place([50]), n, 1), given_draws)
    assert np.mean(delivery.delay_s) == pytest.approx(0.1 + 0.0515, abs=4e-4)
    both = np.mean(1 - delivery.loss) ** 2
    assert np.mean(delivery.up) == pytest.approx(both, abs=0.01)


def test_a_larger_message_takes_several_blocks_that_must_all_cross():
    one, three = (
        BUSY.deliver(links(place([100]), 50, 1, bits), draws(50, 1)) for bits in (1520, 3041)
    )
    np.testing.assert_allclose(three.loss, 1 - (1 - one.loss) ** 3)
    np.testing.assert_allclose(three.airtime_s, 0.003)
    np.testing.assert_allclose(three.delay_s - one.delay_s, 0.002)
    assert np.all(one.up >= three.up)


def test_a_copy_helps_a_quiet_channel_and_not_what_is_too_faint():
    twice = replace(QUIET, transmissions=2)
    near, far = place([30]), place([900])
    # Each of the two copies meets a receiver that now sends 20 ms a second.
    assert twice.loss(near, np.zeros(1), 800.0)[0] == pytest.approx((1 - 0.98 * 0.999) ** 2)
    assert twice.loss(far, np.full(1, -2.0), 800.0)[0] == 1.0


@pytest.mark.parametrize(
    ("jitter", "heard"),
    [
        ([0.5, 0.5, 0.9], [False, False, True]),  # one slot and sub-channel
        (
            [0.5, 0.5 + 0.5 / 100, 0.9],
            [True, True, True],
        ),  # one slot, another sub-channel
        ([0.5, 0.51, 0.9], [True, True, True]),  # the next slot
    ],
)
def test_two_replies_in_one_slot_and_sub_channel_are_both_lost(jitter, heard):
    three = links(place([10, 12, 14]), 1, 3)
    always = Draws(np.ones((1, 3, 2)), np.array([jitter]), draws(1, 3).trips)
    always.__dict__["packet"] = np.full((1, 3, 2), 0.999)
    assert QUIET.deliver(three, always).up.tolist() == [heard]
    # Who has not heard the request sends nothing that could clash.
    always.__dict__["packet"][0, 0, 0] = 0.0
    assert QUIET.deliver(three, always).up[0].tolist() == [False, True, True]
    asked = np.array([[False, True, True]])
    unasked = replace(three, asked=asked, ready_s=np.where(asked, 0.1, np.nan))
    assert QUIET.deliver(unasked, always).up[0, 1:].tolist() == [True, True]


def test_a_helper_that_is_not_there_changes_nobody():
    alone = BUSY.deliver(links(place([50, 80]), 5, 2), draws(5, 2))
    beside = BUSY.deliver(links(place([50, 80, np.nan]), 5, 3), draws(5, 3))
    np.testing.assert_array_equal(beside.loss[:, :2], alone.loss)


def test_settings_that_are_no_radio_s_are_refused():
    with pytest.raises(UserError, match="subchannels is 3: give 2 or 4"):
        replace(QUIET, subchannels=3)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="t2_slots is 0: give 1 or more"):
        LteMode4(t2_slots=0)
    with pytest.raises(UserError, match=r"density_per_km is nan: give a number from 0 to 10000"):
        LteMode4(density_per_km=np.nan)
    with pytest.raises(UserError, match="physical radio"):
        BUSY.deliver(replace(links(place([50]), 1, 1), site=None), draws(1, 1))


# NR Mode 2.


@pytest.mark.parametrize(
    ("numerology", "wait_ms"), some([(1, 8.75)], exhaustive=[(0, 17.5), (2, 4.375)])
)
def test_a_message_in_nr_waits_17_5_slots_on_average(numerology, wait_ms):
    radio = replace(NR, numerology=numerology)
    asked = radio.request(400.0, draws(20_000, 1))
    assert np.mean(asked.heard_s) - asked.airtime_s == pytest.approx(wait_ms / 1000, rel=0.01)
    assert asked.airtime_s == pytest.approx(0.001 / 2**numerology)


def test_half_duplex_is_a_slot_a_packet():
    for numerology, missed in ((0, 0.01), (1, 0.005), (2, 0.0025)):
        radio = replace(NR, density_per_km=0.0, numerology=numerology)  # type: ignore[arg-type]
        assert radio.loss(place([5]), np.zeros(1), 800.0)[0] == pytest.approx(missed)


def test_a_packet_takes_the_sub_channels_that_it_needs():
    # At 15 kHz a block has 132 data symbols of 2 * 526 / 1024 bits, 135.6 bits: 1 520 bits need
    # 11.2.
    radio = NrMode2(bandwidth_mhz=10, subchannel_blocks=10, mcs=7, packet_bytes=190)
    assert radio.block_bits == int(20 * 132 * 2 * 526 / 1024)
    assert radio.blocks_per_slot == 52 // 10 // 2
    assert radio.noise_dbm == pytest.approx(-174 + 10 * np.log10(20 * 180e3) + 9)
    assert radio.block_error(np.array(9.15)) == pytest.approx(0.5), "the curve of MCS 7"
    # MCS 14: 4 * 553 / 1024 = 2.16 bits, 2^(2.16 / 0.4) - 1 = 41.2, 16.1 dB.
    assert NR.block_error(np.array([16.1, 16.2])).tolist() == [1.0, 0.0]
    with pytest.raises(UserError, match="raise bandwidth_mhz or mcs"):
        replace(radio, numerology=2, packet_bytes=300)


def test_the_profile_mode2_has_the_set_up_of_the_simulations_it_is_held_against():
    radio = CHANNELS["mode2"]
    assert isinstance(radio, NrMode2)
    # 4.5e-17 W/Hz in each of 10 resource blocks of 180 kHz.
    assert radio.sensing_dbm == pytest.approx(10 * np.log10(4.5e-17 * 10 * 180e3) + 30, abs=0.02)
    # Free space in sight: 23 dBm less 93.9 dB, at 201.6 m. Half is above that, less half duplex.
    alone = replace(radio, density_per_km=0.0)
    reach_m = np.array([10 ** ((23 + 70.9 - 32.4 - 20 * np.log10(5.89)) / 20)])
    assert alone.reception(reach_m, CLEAR)[0] == pytest.approx(0.5 * 0.99, abs=0.005)
    # 2^(2.16 / 0.62) - 1 = 10.2, 10.1 dB.
    assert radio.block_error(np.array([10.0, 10.2])).tolist() == [1.0, 0.0]
    assert outside(asdict(radio), CHANNELS.profile("mode2").limits) == []


def test_the_selection_window_is_in_the_delay_alone():
    distances_m = np.arange(20.0, 500, 20)
    short = replace(NR, t2_slots=17)
    np.testing.assert_array_equal(NR.reception(distances_m), short.reception(distances_m))
    uniform = draws(1000, 1)
    assert np.mean(short.request(400.0, uniform).heard_s) < np.mean(
        NR.request(400.0, uniform).heard_s
    )


def test_twice_the_bandwidth_in_half_as_long_slots_is_half_as_busy():
    coarse = NrMode2(density_per_km=20.0, bandwidth_mhz=20)
    fine = replace(coarse, bandwidth_mhz=40, numerology=1)
    assert coarse.blocks_per_slot == fine.blocks_per_slot == 2
    assert fine.busy_ratio() == pytest.approx(coarse.busy_ratio() / 2, rel=0.05)


@pytest.mark.exhaustive
def test_where_a_real_radio_is_what_the_paper_declares():
    """8 % and 25 ms: Mode 4 at 150 to 250 m beside 200 vehicles a km. 1.2 % and 5 ms:
    Mode 2 at 50 m.
    """
    v2x = replace(BUSY, t2_slots=50)
    lost = 1 - v2x.reception(np.array([150.0, 200, 250]))
    assert lost[0] < 0.08 < lost[2]
    assert np.mean(v2x.request(400.0, draws(20_000, 1)).heard_s) == pytest.approx(0.0265, abs=3e-4)
    short = NrMode2(numerology=2, mcs=7, subchannel_blocks=10, packet_bytes=190)
    assert 1 - short.reception(np.array([50.0]))[0] == pytest.approx(0.012, abs=0.004)
    assert np.mean(short.request(400.0, draws(20_000, 1)).heard_s) == pytest.approx(
        0.0046, abs=1e-4
    )


# Semi-persistent scheduling.


def test_resources_taken_by_hand():
    # 8 packets on 20 resources: 4 apart, and 4 more on 16 that are free: 1 - 1/16, 1 - 2/16, ...
    assert taken(8, 20) == pytest.approx(4 + 4 - (1 + 2 + 3 + 4) / 16)
    assert taken(0, 20) == 0
    assert taken(1000, 20) == 20


@pytest.mark.parametrize("threshold", [0.2, 0.5])
def test_who_knows_nothing_of_each_other_meets_by_chance(threshold):
    nobody = Scheduling(0.1, 100, 0.1, lambda metres, _: np.zeros_like(metres), threshold)
    np.testing.assert_allclose(nobody.same_by_exclusion(np.array([10.0, 900])), 1 / 100)


@pytest.mark.parametrize(
    ("spacing_m", "vehicles", "slots"),
    [
        pytest.param(20.0, 100, 20_000, marks=pytest.mark.slow),
        pytest.param(10.0, 200, 100_000, marks=pytest.mark.exhaustive),
        pytest.param(20.0, 100, 100_000, marks=pytest.mark.exhaustive),
    ],
)
def test_the_closed_forms_agree_with_many_slots_of_simulated_scheduling(spacing_m, vehicles, slots):
    """A ring of vehicles that sense all within 300 m, 2 sub-channels, 10 Hz,
    counters of 5 to 15.
    """
    reach_m = 300.0
    busy, same = simulated(vehicles, spacing_m, reach_m, subchannels=2, slots=slots)
    model = Scheduling(
        1 / spacing_m, 200, 0.1, lambda metres, _: np.where(metres <= reach_m, 1.0, 0.0), 0.0
    )
    apart_m = spacing_m * np.arange(1, vehicles // 2 + 1)
    expected = model.same_by_exclusion(apart_m)
    assert model.busy_ratio == pytest.approx(busy, rel=0.03)
    hidden = apart_m > reach_m
    assert expected[hidden].mean() == pytest.approx(same[hidden].mean(), rel=0.08)
    # In reach the equation lets a collision last as long as a choice; it ends with the first of
    # two.
    assert 1.1 < expected[~hidden].mean() / same[~hidden].mean() < 1.5


def simulated(vehicles, spacing_m, reach_m, subchannels, slots, period=100):
    """Share of resources found taken; how often two that are so many places apart share one."""
    rng = np.random.default_rng(0)
    places = np.abs(np.arange(vehicles)[:, None] - np.arange(vehicles))
    apart_m = spacing_m * np.minimum(places, vehicles - places)
    near = [np.flatnonzero((row > 0) & (row <= reach_m)) for row in apart_m]
    chosen = rng.integers(period * subchannels, size=vehicles)
    heard, counter = chosen.copy(), rng.integers(1, 16, vehicles)
    due = [set(np.flatnonzero(chosen // subchannels == slot)) for slot in range(period)]
    busy, same, looks = [], np.zeros(vehicles // 2), 0
    for slot in range(slots):
        for v in list(due[slot % period]):
            heard[v] = chosen[v]  # from now on the others know
            counter[v] -= 1
            if counter[v] == 0:
                free = np.setdiff1d(np.arange(period * subchannels), heard[near[v]])
                busy.append(1 - len(free) / (period * subchannels))
                due[slot % period].remove(v)
                chosen[v], counter[v] = rng.choice(free), rng.integers(5, 16)
                due[chosen[v] // subchannels].add(v)
        if slot > slots // 10 and slot % period == 0:
            looks += 1
            same += [np.sum(chosen == np.roll(chosen, k)) for k in range(1, vehicles // 2 + 1)]
    return np.mean(busy), same / looks / vehicles
