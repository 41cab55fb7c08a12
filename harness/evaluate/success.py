"""How an episode of frozen decisions is scored, without a simulator.

The rule. The scene's outcome table judges a decision: its action, followed by the full-view driver,
either clears the intersection (it is *safe*) or does not; a safe action clears it some seconds later than the
best safe action would have (its *delay*). An episode succeeds if every decision is safe and the delays add up
to no more than the scenario's allowance. A decision in which no action is safe does not count.

Why the delays count: after one needless SLOWER a perfect driver still gets through, so "safe" alone would
make always braking perfect. The closed loop is judged alike: clearing later than the full-view driver by
more than the allowance is a forced failure. `harness dataset rank` compares the two.
"""

import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from harness.core import kept
from harness.core.arrays import Bools, Floats, Ints
from harness.core.files import canonical_json, digest
from harness.dataset.load import Dataset
from harness.world import scenarios
from harness.world.drivers import DRIVERS, PRIVILEGED, choose
from harness.world.outcome import ROUNDING_S
from harness.world.perception.graph import truth_graph

# The code that a reference driver's success depends on: what other code kept does not count.
_CODE = ("core/**/*.py", "world/**/*.py", "dataset/**/*.py", "evaluate/success.py")


@dataclass(frozen=True)
class Verdict:
    """How episodes ended, each array of shape (...).

    Attributes:
        success: every avoidable decision safe, delays within the allowance.
        unsafe: some avoidable decision led to a collision or a forced failure.
        late: all safe, but too late.
        delay_s: delays added up, unsafe decisions left out.
    """

    success: Bools
    unsafe: Bools
    late: Bools
    delay_s: Floats


def judge(safe: Bools, delay_s: Floats, avoidable: Bools, allowance_s: float) -> Verdict:
    """Judge episodes.

    Args:
        safe: whether the chosen action was safe, (..., S); S decisions an episode.
        delay_s: delay of the chosen action, (..., S); NaN where it was not safe.
        avoidable: whether any action was safe, (..., S); False also pads episodes with fewer decisions.
        allowance_s: delay that is forgiven.
    """
    unsafe = np.any(avoidable & ~safe, axis=-1)
    total = np.sum(np.where(avoidable & safe, np.nan_to_num(delay_s), 0.0), axis=-1)
    late = ~unsafe & (total > allowance_s + ROUNDING_S)
    return Verdict(~unsafe & ~late, unsafe, late, total)


@dataclass(frozen=True)
class Table:
    """A dataset's scenes laid out as episodes by steps, so that arrays can be judged.

    Attributes:
        index: (E, S) position of each decision among the scenes; -1 pads shorter episodes.
        episodes: (E,) episode numbers.
        seeds: (E,) layout seeds.
        safe: (n, A) whether an action is safe.
        delay_s: (n, A) its delay; NaN where it is not.
        allowance_s: delay that an episode is forgiven.
    """

    index: Ints
    episodes: Ints
    seeds: Ints
    safe: Bools
    delay_s: Floats
    allowance_s: float

    def by_episode(self, values: Any, fill: Any = np.nan) -> Any:
        """Values (n, ...) as (E, S, ...), `fill` where an episode has no such step."""
        there = self.index >= 0
        laid = values[self.index]
        if there.all():
            return laid
        return np.where(there.reshape(there.shape + (1,) * (laid.ndim - 2)), laid, fill)


def table(dataset: Dataset) -> Table:
    """Lay a dataset's scenes out as episodes."""
    places: dict[int, list[int]] = {}
    for position, scene in enumerate(dataset.scenes):
        places.setdefault(scene.record["episode"], []).append(position)
    index = np.full((len(places), max(map(len, places.values()))), -1)
    for row, positions in enumerate(places.values()):
        index[row, : len(positions)] = positions
    safe, delay_s = dataset.outcome_arrays()
    seeds = [dataset.scenes[p[0]].record["episode_seed"] for p in places.values()]
    allowance_s = dataset.manifest.number("delay_allowance_s")
    return Table(index, np.array(list(places)), np.array(seeds), safe, delay_s, allowance_s)


def judge_choices(laid: Table, chosen: Ints) -> Verdict:
    """How the episodes end if action `chosen` (n,) is taken in each scene."""
    rows = np.arange(len(chosen))
    return judge(
        laid.by_episode(laid.safe[rows, chosen], fill=True),
        laid.by_episode(laid.delay_s[rows, chosen]),
        laid.by_episode(laid.safe.any(axis=-1), fill=False),
        laid.allowance_s,
    )


def driver_choices(dataset: Dataset, driver: str) -> Ints:
    """Index of a reference driver's action in every scene, (n,)."""
    actions, scenario = dataset.actions, dataset.scenario
    chosen = []
    for scene in dataset.scenes:
        graph = scene.record["graphs"][scene.state.ego.id]
        truth = truth_graph(scenario, scene.state) if driver == PRIVILEGED else None
        chosen.append(actions.index(choose(scenario, driver, graph, truth)))
    return np.array(chosen)


def reference_success(dataset: Dataset) -> dict[str, float]:
    """Share of a dataset's episodes in which each reference driver succeeds; computed once and then kept."""
    laid = table(dataset)
    here = scenarios.is_here(dataset.scenario.name)  # of another's code no digest is known
    decided_by = [
        dataset.sha256, laid.episodes.tolist(), kept.code_sha256(*_CODE), version("numpy"), version("shapely")
    ]  # fmt: skip
    name = f"references-{digest(decided_by)}.json"
    shares = _shares(kept.recall(name)) if here else None
    if shares is None:
        shares = {
            driver: float(judge_choices(laid, driver_choices(dataset, driver)).success.mean())
            for driver in DRIVERS
        }
        if here:
            kept.keep(name, canonical_json(shares).encode())
    return shares


def _shares(data: bytes | None) -> dict[str, float] | None:
    """The kept share of every reference driver; None if the file holds something else."""
    try:
        shares = json.loads(data or b"")
        by_driver = {driver: float(shares[driver]) for driver in DRIVERS}
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return by_driver if all(0.0 <= share <= 1.0 for share in by_driver.values()) else None
