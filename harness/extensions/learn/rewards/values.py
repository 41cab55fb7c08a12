"""What every action is worth at the decision points of trees, as arrays:
rewards without a simulator.

The worth of an action is the probability that the episode succeeds after it.
Trees give it exactly, whoever decides from there on:

- `best`: whoever decides best and sees everything. It is 1 or 0: whether success is still possible.
- a reference driver, such as `local-view`, which sees no more than the ego. It is 1 or 0 as well.
- `uniform`: every action is drawn with the same probability.

The worth of a distribution at a decision point is `sum_a p(a) v(a)`, and its gradient in p is v.
Where success is out of reach after every action, nothing can be learnt: the point is `lost`.

Most points forgive nearly every action, so that one action that is always taken is worth nearly as
much as the best. So an answer's reward is its *advantage* over such a constant: the worth of the
action that it drives, less that of the action which did best in tune layouts of the scenario (the
driver `constant`). Points in which all actions are worth the same are left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import unknown
from harness.dataset.forest import Forest
from harness.world.drivers import UNIFORM

BEST = "best"


@dataclass(frozen=True)
class Values:
    """Hold the worth of A actions at N decision points: the probability of success after each.

    A decision point is a situation in which the ego must act. Worth depends on who decides in the
    rest of the episode, `then`.
    """

    ids: tuple[str, ...]  # ids of the decision points
    actions: tuple[str, ...]  # the meta-actions
    then: str  # who decides after the action: `best`, `uniform` or a reference driver
    table: Floats  # worth of each action, (N, A)

    @classmethod
    def of(cls, forest: Forest, then: str = BEST) -> "Values":
        """Compute the probability of success after every action at every decision point.

        `forest` has the dataset's decision trees: every course that actions can lead to, from each
        start situation. `then` decides after the action: `best`, `uniform` or a reference driver, a
        rule. Raises UserError if it is none of these.
        """
        if then == BEST:
            table = forest.safe.astype(float)
        elif then == UNIFORM:
            table = forest.chance(np.ones(forest.child.shape))
        elif then in forest.drivers:
            table = forest.chance(np.eye(len(forest.actions))[forest.drivers[then]])
        else:
            raise unknown("then", then, [BEST, UNIFORM, *forest.drivers])
        return cls(forest.ids, forest.actions, then, table)

    def __call__(self, points: Sequence[str] | Ints, p: Floats | None = None) -> Floats:
        """Return the worth of each of A actions at n decision points, (n, A).

        Given distributions `p` (n, A), return their mean worth, (n,). The points are ids, or
        indices into `ids`, which is faster. Raises KeyError for an unknown id.
        """
        places = points if isinstance(points, np.ndarray) else self.at(points)
        values = self.table[places]
        return values if p is None else np.einsum("na,na->n", p, values)

    def at(self, ids: Sequence[str]) -> Ints:
        """Return the indices in `self.ids` of the n decision points with these ids, (n,).

        A decision point is a situation in which the ego must act. Raises KeyError for an unknown
        id.
        """
        return np.fromiter(map(self.place.__getitem__, ids), np.intp, len(ids))

    @cached_property
    def place(self) -> Mapping[str, int]:
        return {name: n for n, name in enumerate(self.ids)}

    @cached_property
    def lost(self) -> Bools:
        """Return at which of the N decision points no action can lead to success, (N,).

        A decision point is a situation in which the ego must act.
        """
        return np.asarray(~self.table.any(axis=-1))

    @cached_property
    def decides(self) -> Bools:
        """Return at which of the N decision points it matters what is done, (N,).

        A decision point is a situation in which the ego must act; there the probability of success
        differs between actions.
        """
        return np.asarray(self.table.max(axis=-1) > self.table.min(axis=-1))


def balanced(success: Floats | Bools, dangerous: Bools) -> float:
    """Return the mean of success (E,), 0 to 1, over E layouts of which both kinds weigh alike.

    A layout is a start situation. The kinds are those with a danger, a vehicle that the ego would
    meet, and without: `dangerous` (E,) says which have one. If all are of one kind, it is their
    plain mean.
    """
    kinds = [success[kind].mean() for kind in (dangerous, ~dangerous) if kind.any()]
    return float(np.mean(kinds))


def best_constant(forest: Forest, dangerous: Bools) -> int:
    """Return the index of the action that succeeds most if always taken, by balanced success.

    Balanced success is the mean of that in layouts with a danger, a vehicle that the ego would
    meet, and without; `dangerous` (E,) says which of E layouts (start situations) have one.
    `forest` has their decision trees, every course that actions can lead to. Of equal actions it is
    the first.
    """
    success = [balanced(forest.constant_success(action), dangerous) for action in forest.actions]
    return int(np.argmax(success))


def drawn(forest: Forest, dangerous: Bools, of: Bools, per_level: int, scenario: str) -> Ints:
    """Draw about `per_level` decision points of each step of each tree; return their indices, (n,).

    The indices are ascending, among the forest's N points. Only points where the mask `of` (N,) is
    true are drawn, keyed by scenario and layout seed; where a step has too few, they repeat.
    `dangerous` (E,) says which of the E trees' layouts (start situations) have a danger, a vehicle
    that the ego would meet; of the rarer kind of layout more are drawn, so that both kinds have as
    many in all. `scenario` is the scenario's name.
    """
    alike = np.where(dangerous, dangerous.sum(), (~dangerous).sum())
    kinds = len(np.unique(dangerous))
    counts = np.maximum(1, np.round(per_level * len(dangerous) / kinds / alike)).astype(int)
    sizes = np.bincount(forest.tree).tolist()
    seeds = forest.seeds.tolist()
    of_trees = []
    for size, seed in zip(sizes, seeds, strict=True):
        of_trees.append(noise.uniforms((size,), "rows", scenario, seed))
    draws = np.concatenate(of_trees)
    levels = forest.tree * (int(forest.step.max()) + 1) + forest.step
    order = np.lexsort((draws, levels))
    order = order[of[order]]
    _, first, there = np.unique(levels[order], return_index=True, return_counts=True)
    chosen = list[Ints]()
    for start, size in zip(first.tolist(), there.tolist(), strict=True):
        count = int(counts[forest.tree[order[start]]])
        chosen.append(order[start + np.arange(count) % size])
    return np.sort(np.concatenate(chosen)) if chosen else np.array([], np.intp)


def optimal(values: Floats) -> Bools:
    """Return which of A actions have the greatest worth, a mask (..., A), for `values` (..., A).

    The worth of an action is the probability of success after it. The mask is false for all where
    every action is worth 0 or NaN (unknown).
    """
    most = values.max(axis=-1, keepdims=True)
    return np.asarray((values == most) & (most > 0))
