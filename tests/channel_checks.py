"""What holds of every channel: each link has a fate, and no row another row's."""

from dataclasses import replace

import numpy as np

from harness.radio.channel import Antenna, ByLink, Channel, Draws, Links, Site
from harness.radio.fading import Trips
from harness.radio.wrapped import heard_s


def check_channel(channel: Channel) -> None:
    links, draws = links_and_draws((40, 4))
    up, delay_s, loss, airtime_s = channel.deliver(links, draws)
    assert up.shape == delay_s.shape == (40, 4)
    assert loss.shape in ((40, 4), (40, 1))
    assert airtime_s.shape == (40, 4)
    small, large = (channel.request(bits, draws) for bits in (400.0, 800.0))
    heard = [heard_s(channel, request, links, draws) for request in (small, large)]
    assert np.all(heard[0] >= 0)
    assert np.all(heard[0] <= heard[1])
    if not isinstance(channel, ByLink):
        assert 0 <= small.airtime_s <= large.airtime_s
    assert np.array_equal(np.isfinite(delay_s), links.asked)
    assert np.all((delay_s >= links.ready_s)[links.asked])
    assert np.nanmin(loss) >= 0
    assert np.nanmax(loss) <= 1
    alone = channel.deliver(links.take(7), draws.take(7))
    for batch, single in zip((up, delay_s, loss, airtime_s), alone, strict=True):
        assert np.array_equal(batch[7], single, equal_nan=True)


def somewhere(shape: tuple[int, ...], rng: np.random.Generator) -> Site:
    return Site(
        rng.uniform(-90, 90, (shape[0], 1 + shape[1], 2)),
        rng.integers(0, 3, shape),
        rng.choice([0.0, 1.5, 3.6], shape),
        rng.choice([30.0, np.nan], (*shape, 1)) * np.ones(2),
    )


def links_and_draws(shape: tuple[int, ...], seed: int = 0) -> tuple[Links, Draws]:
    rng = np.random.default_rng(seed)
    asked = rng.random(shape) < 0.6
    links = Links(
        asked,
        np.where(asked, rng.uniform(0, 0.1, shape), np.nan),
        np.where(asked, rng.uniform(1, 90, shape), np.nan),
        np.where(asked, rng.uniform(0, 8000, shape), np.nan),
        asked | (rng.random(shape) < 0.5),
        asked & (rng.random(shape) < 0.5),
        400.0,
        replace(
            somewhere(shape, rng),
            antennas={Antenna(0.0, 0.0, 5.0): somewhere((shape[0], 1 + shape[1]), rng)},
        ),
    )
    trips = Trips(
        rng.integers(0, 3, shape[0]), rng.integers(0, 9, shape[0]), rng.integers(0, 6, shape[0]), 6
    )
    return links, Draws(rng.random((*shape, 2)), rng.random(shape), trips)
