"""Scoring: the same intents under every condition and seed, decision by decision and episode by episode."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from harness.coordination.coordinate import Coordination, Merge, coordinate
from harness.coordination.exchange import Luck
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise as luck
from harness.core.arrays import Bools, Floats
from harness.evaluate.intents import Intents
from harness.evaluate.merging import Merged
from harness.evaluate.success import Table, Verdict, judge_choices


@dataclass(frozen=True)
class Scored:
    """One condition and seed.

    Attributes:
        point: the operating point.
        seed: seed of the channel's luck.
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
    known: Intents,
    inference_s: Floats,
    point: OperatingPoint,
    seed: int,
    drawn: Luck,
    merge: Merge | None = None,
) -> Scored:
    """Coordinate every decision at one operating point with one seed's luck, and look up what comes of it.

    `inference_s` is (n, 1+H), the ego first. Where the ego's is unknown (NaN), so is the decision's latency.
    `drawn` is the luck of that seed, for every point the same. `merge` is the ego's second answers, if the
    point needs them.
    """
    result = coordinate(
        point, known.own, known.helpers, known.valid, known.distance_m, known.range_m,
        known.payload_bits, np.nan_to_num(inference_s), drawn, merge,
    )  # fmt: skip
    result = replace(result, latency_s=np.where(np.isnan(inference_s[:, 0]), np.nan, result.latency_s))
    return outcome(laid, point, seed, result)


def outcome(laid: Table, point: OperatingPoint, seed: int, made: Coordination) -> Scored:
    """What comes of the actions taken."""
    rows = np.arange(len(made.action))
    safe, delay_s = laid.safe[rows, made.action], laid.delay_s[rows, made.action]
    return Scored(point, seed, made, safe, delay_s, judge_choices(laid, made.action))


def draw(laid: Table, seed: int, shape: tuple[int, ...]) -> Luck:
    """The channel's luck, (n, H): a link is up or down for a whole episode, jitter is drawn a decision.

    The key is the seed and the episode's layout, so every condition, prompt and model sees the same.
    """
    n, helpers = shape
    link, jitter = np.zeros((n, helpers, 2)), np.zeros((n, helpers))
    for row, episode_seed in zip(laid.index, laid.seeds, strict=True):
        drawn = luck.uniforms((2 + len(row), helpers), "channel", seed, int(episode_seed))
        there = row[row >= 0]
        link[there] = drawn[:2].T
        jitter[there] = drawn[2 : 2 + len(there)]
    return Luck(link, jitter)


def statuses(known: Intents, second: Merged | None = None) -> Mapping[str, list[str]]:
    """Parse verdicts by role, one an answer; `merge` are the ego's second ones."""
    return {
        "ego": [row[0].verdict for row in known.parsed if row[0]],
        "helper": [p.verdict for row in known.parsed for p in row[1:] if p],
        "merge": [p.verdict for p in second.parsed] if second else [],
    }
