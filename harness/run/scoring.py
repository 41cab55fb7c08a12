"""Scoring: the same intents under every condition and seed, decision by decision and episode by episode."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness import luck
from harness.arrays import Bools, Floats, Ints
from harness.coordination import Coordination, Luck, coordinate
from harness.frozen import Verdict, judge
from harness.metrics import brier, negative_log_likelihood, safe_target
from harness.operating_point import OperatingPoint
from harness.run.intents import Intents
from harness.run.spec import Spec


@dataclass(frozen=True)
class Table:
    """A dataset's scenes laid out as episodes by steps, so that arrays can be judged.

    Attributes:
        index: (E, S) position of each decision among the scenes; -1 pads shorter episodes.
        episodes: (E,) episode numbers.
        seeds: (E,) layout seeds.
        safe: (n, A) whether an action is safe.
        delay_s: (n, A) its delay; NaN where it is not.
    """

    index: Ints
    episodes: Ints
    seeds: Ints
    safe: Bools
    delay_s: Floats

    def by_episode(self, values: Any, fill: Any = np.nan) -> Any:
        """Values (n, ...) as (E, S, ...), `fill` where an episode has no such step."""
        there = self.index >= 0
        laid = values[np.maximum(self.index, 0)]
        return np.where(there.reshape(there.shape + (1,) * (laid.ndim - 2)), laid, fill)


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
        brier: (n,) of the fused policy against the safe actions.
        nll: (n,) of the fused policy.
    """

    point: OperatingPoint
    seed: int
    coordination: Coordination
    safe: Bools
    delay_s: Floats
    verdict: Verdict
    brier: Floats
    nll: Floats


def table(spec: Spec) -> Table:
    """Lay the dataset's scenes out as episodes."""
    places: dict[int, list[int]] = {}
    for position, scene in enumerate(spec.dataset.scenes):
        places.setdefault(scene.record["episode"], []).append(position)
    index = np.full((len(places), max(map(len, places.values()))), -1)
    for row, positions in enumerate(places.values()):
        index[row, : len(positions)] = positions
    safe, delay_s = spec.dataset.outcome_arrays()
    seeds = [spec.dataset.scenes[p[0]].record["episode_seed"] for p in places.values()]
    return Table(index, np.array(list(places)), np.array(seeds), safe, delay_s)


def score(
    spec: Spec,
    laid: Table,
    known: Intents,
    inference_s: Floats,
    point: OperatingPoint,
    seed: int,
    drawn: Luck,
) -> Scored:
    """Coordinate every decision at one operating point with one seed's luck, and look up what comes of it.

    `inference_s` is (n, 1+H), the ego first. Where the ego's is unknown (NaN), so is the decision's latency.
    `drawn` is the luck of that seed, for every point the same.
    """
    result = coordinate(
        point, known.own, known.helpers, known.valid, known.distance_m, known.range_m,
        known.payload_bits, np.nan_to_num(inference_s), drawn,
    )  # fmt: skip
    result = replace(result, latency_s=np.where(np.isnan(inference_s[:, 0]), np.nan, result.latency_s))
    rows = np.arange(len(result.action))
    safe, delay_s = laid.safe[rows, result.action], laid.delay_s[rows, result.action]
    verdict = judge(
        laid.by_episode(safe, fill=True),
        laid.by_episode(delay_s),
        laid.by_episode(laid.safe.any(axis=-1), fill=False),
        allowance_s(spec),
    )
    return Scored(
        point, seed, result, safe, delay_s, verdict,
        brier(result.fused, safe_target(laid.safe)), negative_log_likelihood(result.fused, laid.safe),
    )  # fmt: skip


def allowance_s(spec: Spec) -> float:
    """Delay that the dataset's scenario forgives an episode."""
    return float(spec.dataset.manifest["parameters"]["delay_allowance_s"])


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


def statuses(known: Intents) -> Mapping[str, list[str]]:
    """Parse verdicts by role, one an answer."""
    ego: list[str] = [row[0].verdict for row in known.parsed if row[0]]
    return {"ego": ego, "helper": [p.verdict for row in known.parsed for p in row[1:] if p]}
