"""Scoring: the same intents under every condition and seed, decision by decision and episode by episode."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.coordination.channel import Draws
from harness.coordination.coordinate import Coordination, FusionCall, coordinate
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Bools, Floats
from harness.evaluate.intents import Answered
from harness.evaluate.merging import Merged
from harness.evaluate.success import Table, Verdict, judge_choices


@dataclass(frozen=True)
class Scored:
    """One condition and seed.

    Attributes:
        point: the operating point.
        seed: seed of the channel's draws.
        coordination: what happened in each decision; arrays (n, ...).
        safe: (n,) whether the action taken is safe.
        delay_s: (n,) its delay.
        verdict: what became of the episodes; arrays (E,).
    """

    point: OperatingPoint
    seed: int
    coordination: Coordination
    safe: Bools
    delay_s: Floats
    verdict: Verdict


def score(
    laid: Table,
    intents: Intents,
    point: OperatingPoint,
    seed: int,
    draws: Draws,
    fusion_call: FusionCall | None = None,
) -> Scored:
    """Coordinate every decision at one operating point with one seed's draws, and look up what comes of it.

    `draws` are those of that seed, for every point the same. `fusion_call` is for a point that fuses by one.
    """
    return outcome(laid, point, seed, coordinate(point, intents, draws, fusion_call))


def outcome(laid: Table, point: OperatingPoint, seed: int, made: Coordination) -> Scored:
    """What comes of the actions taken."""
    rows = np.arange(len(made.action))
    safe, delay_s = laid.safe[rows, made.action], laid.delay_s[rows, made.action]
    return Scored(point, seed, made, safe, delay_s, judge_choices(laid, made.action))


def draw(laid: Table, seed: int, shape: tuple[int, ...]) -> Draws:
    """The channel's draws, (n, H): a link is up or down for a whole episode, jitter is drawn a decision.

    The key is the seed and the episode's layout, so every condition, prompt and model sees the same.
    """
    n, helpers = shape
    link, jitter = np.zeros((n, helpers, 2)), np.zeros((n, helpers))
    for row, episode_seed in zip(laid.index, laid.seeds, strict=True):
        drawn = noise.uniforms((2 + len(row), helpers), "channel", seed, int(episode_seed))
        there = row[row >= 0]
        link[there] = drawn[:2].T
        jitter[there] = drawn[2 : 2 + len(there)]
    return Draws(link, jitter)


def statuses(known: Answered, second: Merged | None = None) -> Mapping[str, list[str]]:
    """Parse verdicts by role, one an answer; `merge` are the ego's second ones."""
    return {
        "ego": [row[0].verdict for row in known.parsed if row[0]],
        "helper": [p.verdict for row in known.parsed for p in row[1:] if p],
        "merge": [p.verdict for p in second.parsed] if second else [],
    }
