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
def _channel_uniforms(
    seed: int, layout_seed: int, steps: int, at_first: int, helpers: int
) -> Floats:
    drawn = noise.uniforms((2 + steps, at_first), "channel", seed, layout_seed)
    if helpers > at_first:
        # One helper after another, so that more of them change no earlier one's.
        shape = helpers - at_first, 2 + steps
        later = noise.uniforms(shape, "channel of later helpers", seed, layout_seed)
        drawn = np.concatenate([drawn, later.T], axis=-1)
    return drawn[:, :helpers]


def channel_draws(
    seed: Ints, layout_seed: Ints, step: Ints, steps: int, helpers: int, at_first: Ints
) -> Draws:
    """Return the channel's random draws for n decisions: whether messages are lost, and how late.

    The draws' keys are the seed of the channel, the seed of the episode's layout (start situation)
    and the number of the decision in its episode, `(n,)` each; so every condition, prompt and model
    has the same draws. Episodes have at most `steps` decisions, and each decision has draws for the
    links to `helpers` helpers, by their numbers. Whether a link is up is drawn once an episode,
    jitter at each step. A condition is a named set of settings of the radio, of asking helpers and
    of fusing their messages.

    `at_first` is how many helpers the first decision of each decision's episode has, `(n,)`: draws
    of these depend on it, and on nothing else that is played.
    """
    seeds, seed_index = np.unique(seed, return_inverse=True)
    layouts, layout_index = np.unique(layout_seed, return_inverse=True)
    # One number for each pair: `np.unique` of rows takes several times as long.
    pairs, decision_of_pair, pair_of_decision = np.unique(
        seed_index * len(layouts) + layout_index, return_index=True, return_inverse=True
    )
    pair_index = np.divmod(pairs, max(len(layouts), 1))
    keys = zip(
        seeds[pair_index[0]].tolist(),
        layouts[pair_index[1]].tolist(),
        at_first[decision_of_pair].tolist(),
        strict=True,
    )
    uniforms = np.array([_channel_uniforms(s, n, steps, first, helpers) for s, n, first in keys])
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
