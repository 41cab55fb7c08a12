"""Who attacks under a condition, and what the ego then hears.

Attackers are drawn once for a seed of the channel and a layout, so every rule, prompt and model faces the
same, in frozen scenes, sweeps and the closed loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from harness.coordination.attacks import Turn, attackers, attacks_of
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Bools, Floats
from harness.core.errors import UserError
from harness.radio.channel import Draws
from harness.radio.fading import Trips


@dataclass(frozen=True)
class Said:
    """What reaches the channel in decisions (n,), of H voices.

    Attributes:
        intents: what is intended and claimed.
        draws: of the channel, a voice each.
        attackers: whose voice is an attacker's, (n, H).
    """

    intents: Intents
    draws: Draws
    attackers: Bools

    def take(self, at: Any) -> "Said":
        """What is said in the decisions at these places."""
        return Said(self.intents.take(at), self.draws.take(at), self.attackers[at])


class Attackers:
    """The attackers under one condition. They remember what helpers intended, each episode and seed apart."""

    def __init__(self, point: OperatingPoint) -> None:
        self._attacks = attacks_of(point.attack)
        self._steps = max((attack.steps for attack in self._attacks), default=0)
        self._intended: dict[tuple[int, int], list[Floats]] = {}

    def said(self, truth: Intents, draws: Draws, episodes: Sequence[tuple[int, int]]) -> Said:
        """What is said where `truth` (n, H) is intended.

        Args:
            truth: what every vehicle intends.
            draws: of the channel.
            episodes: number and seed of each decision's episode.
        """
        nobody = np.zeros(truth.valid.shape, dtype=bool)
        if not self._attacks:
            return Said(truth, draws, nobody)
        if draws.trips is None:
            raise UserError("attacks need layouts, and the paper's study has none; leave attack out")
        uniforms = _uniforms(draws.trips, truth.valid.shape[1])
        first, past = self._remembered(truth, episodes)
        there, said, by = np.isfinite(truth.range_m), truth, nobody
        for attack in self._attacks:
            of_this = attackers(attack.share, there, uniforms[..., 0])
            said = attack.act(said, Turn(truth, of_this, first, past, uniforms[..., 1]))
            by |= of_this
        for intents, episode in zip(truth.helpers, episodes, strict=True):
            steps = self._intended.setdefault(episode, [])
            steps.append(intents)
            del steps[1 : -self._steps or None]  # but the first and those that an attack looks at
        if said.voice_of is None:
            return Said(said, draws, by)
        voices = np.take_along_axis(by, said.voice_of, axis=-1)
        return Said(said, draws.of_helpers(said.voice_of), voices)

    def _remembered(self, truth: Intents, episodes: Sequence[tuple[int, int]]) -> tuple[Floats, Floats]:
        """The first intents (n, H, A) and those of past steps (n, K, H, A); NaN where there was no step."""
        first = truth.helpers.copy()
        past = np.full((len(first), self._steps, *first.shape[1:]), np.nan)
        for row, episode in enumerate(episodes):
            steps = self._intended.get(episode, [])
            for place, intents in enumerate(steps[: -self._steps - 1 : -1]):
                past[row, place, : len(intents)] = intents[: past.shape[2]]
            if steps:
                first[row, : len(steps[0])] = steps[0][: first.shape[1]]
        return first, past


def _uniforms(trips: Trips, helpers: int) -> Floats:
    """For each helper a draw of the episode and one of the step, (n, H, 2)."""
    keys = zip(trips.seed.tolist(), trips.layout_seed.tolist(), strict=True)
    drawn = np.array([_drawn(seed, layout, trips.steps, helpers) for seed, layout in keys])
    of_step = drawn[np.arange(len(drawn)), :, 1 + trips.step]
    return np.stack([drawn[..., 0], of_step], axis=-1)


# Each helper's draws come after the last one's, so that a batch with more helpers changes nobody's.
@lru_cache(maxsize=1 << 14)
def _drawn(seed: int, layout_seed: int, steps: int, helpers: int) -> Floats:
    return noise.uniforms((helpers, 1 + steps), "attackers", seed, layout_seed)
