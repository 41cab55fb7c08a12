"""Draw the luck of decisions: the channel's, and which of equally likely actions is taken."""

from functools import lru_cache

import numpy as np

from harness.coordination.coordinate import TieDraws
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints
from harness.radio.channel import Draws
from harness.radio.fading import Trips

# Added, where draws are keyed, to the numbers of episode and layout, once for each place after the
# ego's.
OF_ANOTHER_AGENT = 1 << 40


@lru_cache(maxsize=1 << 16)
def _channel_uniforms(seed: int, layout_seed: int, steps: int, helpers: int) -> Floats:
    return noise.uniforms((2 + steps, helpers), "channel", seed, layout_seed)


def channel_draws(seed: Ints, layout_seed: Ints, step: Ints, steps: int, helpers: int) -> Draws:
    """Return the channel's random draws for n decisions: whether messages are lost, and how late.

    The draws' keys are the seed of the channel, the seed of the episode's layout (start situation)
    and the number of the decision in its episode, `(n,)` each; so every condition, prompt and model
    has the same draws. Episodes have at most `steps` decisions, and each decision has draws for the
    links to `helpers` helpers. Whether a link is up is drawn once an episode, jitter at each step.
    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    seeds, seed_index = np.unique(seed, return_inverse=True)
    layouts, layout_index = np.unique(layout_seed, return_inverse=True)
    # One number for each pair: `np.unique` of rows takes several times as long.
    pairs, pair_of_decision = np.unique(
        seed_index * len(layouts) + layout_index, return_inverse=True
    )
    pair_index = np.divmod(pairs, max(len(layouts), 1))
    keys = zip(seeds[pair_index[0]].tolist(), layouts[pair_index[1]].tolist(), strict=True)
    uniforms = np.array([_channel_uniforms(s, layout, steps, helpers) for s, layout in keys])
    uniforms = uniforms.reshape(len(pairs), 2 + steps, helpers)
    trips = Trips(seed, layout_seed, step, steps)
    return Draws(
        uniforms[pair_of_decision, :2].transpose(0, 2, 1),
        uniforms[pair_of_decision, 2 + step],
        trips,
    )


@lru_cache(maxsize=1 << 16)
def _tie_uniforms(seed: int, layout_seed: int, steps: int) -> Floats:
    return noise.uniforms((steps,), "ties", seed, layout_seed)


def tie_draws(draws: Draws, ties: str) -> TieDraws | None:
    """Return the function that draws among equally likely actions, for n decisions.

    It takes a mask, `(n,)`, of the decisions that have such a tie and returns a number in [0, 1)
    for each of these. None if `ties` is `first` (not `drawn`), or the draws are of no layouts: the
    first such action is then taken. Keys are those of `draws`: channel seed, layout seed and the
    decision's number in its episode.
    """
    trips = draws.trips
    if ties == "first" or trips is None:
        return None

    def drawn(tied: Bools) -> Floats:
        keys = (key[tied].tolist() for key in (trips.seed, trips.layout_seed, trips.step))
        return np.array(
            [
                _tie_uniforms(seed, layout, trips.steps)[step]
                for seed, layout, step in zip(*keys, strict=True)
            ]
        )

    return drawn
