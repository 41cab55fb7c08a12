"""Hold the decision trees of a dataset as arrays:
where each action leads, its worth, and how a walk ends.

The rule: an episode succeeds if the ego reaches its goal no later than an allowance after the
full-view driver of the same layout, which decides as often and with the same lag
(`Parameters.allowance_s`). A pass from the leaves backwards gives, exactly, the earliest time at
which the goal can still be reached after each action. An action is *safe* if that is early enough
for success. A decision that is not safe, though a safe one was possible, has *lost* the episode:
its regret is 1. A safe decision costs the *delay* in seconds by which the earliest time grows.

A second pass says after which actions harm, a collision or leaving the road, can still be avoided.
A decision after which it cannot, though it could be before, is a *miss*. A decision that has lost
the episode to time alone, since harm can be avoided after it, is a *false alarm*. An episode has at
most one of each: one that ends in harm has a miss, one that ends late or stuck a false alarm,
unless that was inevitable from the start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from msgspec import UNSET, UnsetType

from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.schema import Branching, Edge, End, Tree
from harness.world.conflict_measures import columns
from harness.world.drivers import PRIVILEGED
from harness.world.outcome import RATINGS, ROUNDING_S
from harness.world.parameters import Parameters


@dataclass(frozen=True)
class Forest:
    """Hold the decision trees of a dataset as arrays, and derive what actions are worth.

    A decision tree has every decision point that decisions can lead to from a layout, the start
    situation of an episode. There are E trees with N decision points in all and A actions. Decision
    points are numbered from 0 tree by tree, and within a tree by the number of the decision in its
    episode. An edge is what one or several equivalent actions do at a decision point: it leads to
    another one or ends the episode.
    """

    actions: tuple[str, ...]  # names of the A meta-actions
    # seconds later than the driver that sees everything at which an episode of each tree is still a
    # success, (E,)
    allowance_s: Floats
    time_limit_s: float  # seconds after which every episode ends
    episodes: Ints  # number of each tree's episode, (E,)
    seeds: Ints  # layout seed of each tree, (E,)
    # the sector, a direction, from which the dangerous vehicle of each tree comes, E of them; None
    # without one
    dangers: tuple[str | None, ...]
    root: Ints  # number of each tree's first decision point, (E,)
    ids: tuple[str, ...]  # scene ids of the N decision points
    tree: Ints  # index from 0 of each decision point's tree, (N,)
    step: Ints  # number from 0 of the decision in its episode at each decision point, (N,)
    # number of the decision point to which each action leads, (N, A); -1 if the episode ends
    child: Ints
    edge: Ints  # index in `edges` of the edge that each action takes, (N, A)
    # the edges of all trees, with where each leads and what happens on the way
    edges: tuple[Edge, ...]
    # index of the action that a reference driver takes at each decision point, (N,), by the name of
    # the driver
    drivers: Mapping[str, Ints]

    @classmethod
    def of(
        cls, trees: Sequence[Tree], actions: tuple[str, ...], parameters: Parameters
    ) -> "Forest":
        """Return decision trees as arrays, to compute what actions are worth.

        `trees` are those of a dataset, all of one scenario. `actions` are the names of its actions,
        in order, and `parameters` its settings, such as the time that an episode may last.
        """
        action_index = {action: n for n, action in enumerate(actions)}
        points: list[Branching] = []
        roots, tree_of_point, step_of_point = list[int](), list[int](), list[int]()
        child_rows, edge_rows = list[list[int]](), list[list[int]]()
        edges: list[Edge] = []
        for n, tree in enumerate(trees):
            roots.append(len(points))
            for step, level in enumerate(tree.levels):
                following = len(points) + len(level)  # the first point of the next level
                for point in level:
                    children, point_edges = [-1] * len(actions), [-1] * len(actions)
                    for edge in point.edges:
                        child = -1 if edge.to is None else following + edge.to
                        for action in edge.actions:
                            children[action_index[action]] = child
                            point_edges[action_index[action]] = len(edges)
                        edges.append(edge)
                    child_rows.append(children)
                    edge_rows.append(point_edges)
                tree_of_point += [n] * len(level)
                step_of_point += [step] * len(level)
                points += level
        drivers: dict[str, Ints] = {}
        for name in points[0].drivers:
            drivers[name] = np.array([action_index[point.drivers[name]] for point in points])
        return cls(
            actions,
            np.array([parameters.allowance_s(tree.danger.sector) for tree in trees]),
            parameters.time_limit_s,
            np.array([tree.episode for tree in trees]),
            np.array([tree.episode_seed for tree in trees]),
            tuple(tree.danger.sector for tree in trees),
            np.array(roots),
            tuple(point.scene for point in points),
            np.array(tree_of_point),
            np.array(step_of_point),
            np.array(child_rows),
            np.array(edge_rows),
            tuple(edges),
            drivers,
        )

    @cached_property
    def place(self) -> Mapping[str, int]:
        """Return the number that each decision point has in the arrays, by its scene's id.

        Numbers count from 0.
        """
        return {name: n for n, name in enumerate(self.ids)}

    @cached_property
    def cleared_s(self) -> Floats:
        """Return the time (s) at which each of the edges reaches the goal, (edges,).

        An edge is what an action does, up to the next decision or the end. inf if it ends otherwise
        or leads to another decision point.
        """
        times_s = np.full(len(self.edges), np.inf)
        for n, edge in enumerate(self.edges):
            if edge.end and edge.end.result == "cleared":
                times_s[n] = edge.end.time_s
        return times_s

    @cached_property
    def harms(self) -> Bools:
        """Return whether each of the edges ends in a collision or off the road, (edges,).

        An edge is what an action does, up to the next decision or the end.
        """
        ends = [edge.end for edge in self.edges]
        return np.array([end is not None and RATINGS[end.result] == "unsafe" for end in ends])

    @cached_property
    def conflicts(self) -> Mapping[str, Floats]:
        """Return how near others come on each of the edges, by name of the measure, in s, (edges,).

        The measures are the least time to collision and the least post-encroachment time: from when
        one vehicle leaves a place to when another arrives. An edge is what an action does, up to
        the next decision. The names are those of `conflict_measures.columns`.
        """

        def number(measure_s: float | UnsetType | None) -> float:
            if measure_s is UNSET:
                return np.nan
            return np.inf if measure_s is None else measure_s

        ttc_s = np.array([number(edge.ttc_s) for edge in self.edges])
        pet_s = np.array([number(edge.pet_s) for edge in self.edges])
        return columns(ttc_s, pet_s)

    @cached_property
    def earliest_s(self) -> Floats:
        """Return the earliest time (s) at which the goal can be reached after each action, (N, A).

        There are N decision points and A actions. It counts from the start of the episode; inf if
        it cannot be reached.
        """
        earliest_s = self.cleared_s[self.edge]
        for rows in self.levels_backwards():
            has_child = self.child[rows] >= 0
            after = earliest_s[self.child[rows]].min(axis=-1)
            earliest_s[rows] = np.where(has_child, after, earliest_s[rows])
        return earliest_s

    @cached_property
    def avoids_harm(self) -> Bools:
        """Return whether harm can still be avoided after each action, (N, A).

        There are N decision points and A actions. Harm is a collision, or leaving the road.
        """
        avoids = ~self.harms[self.edge]
        for rows in self.levels_backwards():
            child = self.child[rows]
            avoids[rows] = np.where(child >= 0, avoids[child].any(axis=-1), avoids[rows])
        return np.asarray(avoids)

    @cached_property
    def miss(self) -> Bools:
        """Return whether each action makes harm inevitable, (N, A), that could be avoided before.

        There are N decision points and A actions. Harm is a collision, or leaving the road.
        """
        return np.asarray(self.avoids_harm.any(axis=-1, keepdims=True) & ~self.avoids_harm)

    @cached_property
    def false_alarm(self) -> Bools:
        """Return whether each action makes success impossible by time alone, (N, A).

        There are N decision points and A actions. Success was possible before it, and harm (a
        collision, or leaving the road) can still be avoided after it.
        """
        return np.asarray(self.value[:, None] & ~self.safe & self.avoids_harm)

    @cached_property
    def then_full_view(self) -> Ints:
        """Return the last edge if the full-view driver goes on after each action, (N, A).

        There are N decision points and A actions. It is an index in `edges`, of what is done from
        the last decision to the end. That driver is the reference rule that sees everything.
        """
        last, chosen = self.edge.copy(), self.drivers[PRIVILEGED]
        for rows in self.levels_backwards():
            child = self.child[rows]
            last[rows] = np.where(child >= 0, last[child, chosen[child]], last[rows])
        return last

    def levels_backwards(self) -> list[Ints]:
        """Return the decision points of each step, the last step first."""
        last = int(self.step.max())
        return [np.flatnonzero(self.step == step) for step in range(last, -1, -1)]

    @cached_property
    def reference_s(self) -> Floats:
        """Return when the full-view driver reaches the goal in each of E trees, s, (E,).

        That is the reference rule that sees everything; a tree is of one episode. inf if never.
        """
        return self.cleared_s[self.last_edge(self.drivers[PRIVILEGED])]

    @cached_property
    def limit_s(self) -> Floats:
        """Return the latest time (s) of an arrival that is a success, in each of E episodes, (E,).

        It is the time of the full-view driver, the reference rule that sees everything, plus the
        allowance, but at most the time limit.
        """
        return np.minimum(self.reference_s + self.allowance_s, self.time_limit_s) + ROUNDING_S

    @cached_property
    def safe(self) -> Bools:
        """Return whether the episode can still succeed after each action, a mask (N, A).

        There are N decision points and A actions. Success is reaching the goal no later than
        `limit_s`.
        """
        return self._in_time(self.earliest_s, self.limit_s[self.tree][:, None])

    @cached_property
    def value(self) -> Bools:
        """Return whether the episode can still succeed at each of N decision points, (N,).

        So it is the success of the best policy from there on.
        """
        return np.asarray(self.safe.any(axis=-1))

    @cached_property
    def delay_s(self) -> Floats:
        """Return by how much (s) each action puts off the earliest arrival at the goal, (N, A).

        There are N decision points and A actions. NaN if the action is not safe: no success is
        possible after it.
        """
        soonest_s = self.earliest_s.min(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return np.where(self.safe, self.earliest_s - soonest_s, np.nan)

    def last_edge(self, chosen: Ints) -> Ints:
        """Return the index in `edges` at which each of E episodes ends, (E,), by a fixed policy.

        `chosen` has the index of the action taken at each of N decision points, (N,). An edge is
        what an action does, up to the next decision or the end.
        """
        at, last = self.root.copy(), np.full(len(self.root), -1)
        while (undecided := at >= 0).any():
            action = chosen[at[undecided]]
            last[undecided] = self.edge[at[undecided], action]
            at[undecided] = self.child[at[undecided], action]
        return last

    def visited(self, chosen: Ints) -> Ints:
        """Return the indices of the decision points that a fixed policy goes through, ascending.

        `chosen` has the index of the action taken at each of N decision points, (N,).
        """
        visited, at = [], self.root
        while len(at):
            visited.append(at)
            at = self.child[at, chosen[at]]
            at = at[at >= 0]
        return np.sort(np.concatenate(visited))

    def succeeds(self, edge: Ints, tree: Ints) -> Bools:
        """Return whether episodes that end at some edges succeed, (...).

        `edge`, (...), are indices in `edges`, and `tree`, (...), those of the episodes' trees. An
        edge is what an action does, up to the next decision or the end.
        """
        return self._in_time(self.cleared_s[edge], self.limit_s[tree])

    def unsafe(self, edge: Ints, limits: int) -> Bools:
        """Return whether episodes that end at some edges end unsafely, (...).

        `edge`, (...), are indices in `edges`; an edge is what an action does, up to the next
        decision or the end. `limits` is the scenario's version of limits: with 1 an ego that does
        not reach its goal is unsafe, too.
        """
        if limits == 1:
            return ~np.isfinite(self.cleared_s[edge])
        return np.asarray(self.harms[edge])

    @staticmethod
    def _in_time(goal_s: Floats, limit_s: Floats) -> Bools:
        return np.asarray(np.isfinite(goal_s) & (goal_s <= limit_s))

    def end(self, edge: int) -> End:
        """Return how the episode ends with an edge that ends it, an index in `edges`.

        An edge is what an action does, up to the next decision or the end.
        """
        end = self.edges[edge].end
        assert end is not None
        return end

    def driver_success(self, driver: str) -> Bools:
        """Return whether a reference driver succeeds in each of E episodes, a mask (E,).

        `driver` is its name; such a driver is a rule that decides without a model.
        """
        return self._success(self.drivers[driver])

    def constant_success(self, action: str) -> Bools:
        """Return whether an ego that always takes one action succeeds in E episodes, (E,).

        `action` is the action's name.
        """
        return self._success(np.full(len(self.tree), self.actions.index(action)))

    def sequence_success(self, actions: Sequence[str]) -> Bools:
        """Return whether an ego that takes these actions in turn succeeds in E episodes, (E,).

        After the last one it takes this again.
        """
        return self._success(self.sequence(actions))

    def sequence(self, actions: Sequence[str]) -> Ints:
        """Return the action index at each of N decision points if actions are taken in turn, (N,).

        `actions` are names; the nth is for the nth decision of the episode, and after the last one
        it is taken again.
        """
        indices = np.array([self.actions.index(action) for action in actions])
        return np.asarray(indices[np.minimum(self.step, len(indices) - 1)])

    def _success(self, chosen: Ints) -> Bools:
        return self.succeeds(self.last_edge(chosen), np.arange(len(self.root)))

    def uniform_success(self) -> Floats:
        """Return the probability of success in each of E episodes, (E,), of random actions.

        Each action is drawn with the same probability.
        """
        return np.asarray(self.worth[self.root].mean(axis=-1))

    @cached_property
    def worth(self) -> Floats:
        """Return the probability of success after each action, (N, A), if later ones are random.

        There are N decision points and A actions; every later action is drawn with the same
        probability.
        """
        return self.chance(np.ones(self.child.shape))

    def chance(self, policy: Floats, ends: Bools | None = None) -> Floats:
        """Return the exact probability of success after each action under a policy, (N, A).

        `policy` has the weights of A actions at each of N decision points, (N, A), by which later
        actions are drawn; they need not sum to 1. `ends`, (N, A), says of actions that end the
        episode what is asked for in place of success.
        """
        if ends is None:
            ends = self.succeeds(self.edge, self.tree[:, None])
        chance = ends.astype(float)
        for rows in self.levels_backwards():
            child = self.child[rows]
            after = np.average(chance[child], axis=-1, weights=policy[child])
            chance[rows] = np.where(child >= 0, after, chance[rows])
        return chance
