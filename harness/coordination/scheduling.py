"""Schedules: rules for whom the ego asks and when, from what it knows before it asks.

A schedule is one function of `ScheduleInputs`; `schedules.py` has all of them by name. It returns
what asking each helper is worth, in its own unit. Helpers worth more than the operating point's
threshold are asked, up to the number that the point allows: those worth the most first, and the
nearest first of equals. `entropy` is the paper's schedule (Eq. 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Outlook:
    """Hold how much the ego sees of where a danger may come from, and what helpers would add.

    A place that a danger may come from is one of the road's R sectors, or regions: stretches of
    other roads before the ego's conflict zone. Arrays are of decisions of any shape `(...)`, with H
    helpers; index r of an axis of length R is region r, and index h of one of length H helper h.
    """

    unseen: Floats  # share of each region, 0 to 1, that the ego does not see, `(..., R)`
    # share of each region, 0 to 1, that a helper sees and the ego does not, `(..., H, R)`: it
    # follows from the place in the helper's last beacon and the obstacles that the ego knows. NaN
    # for a helper that is absent.
    added: Floats
    # seconds until the ego reaches the conflict zone at its speed, `(...)`; 0 once it is there, and
    # inf at a standstill
    to_zone_s: Floats
    # how many regions the ego's road has, `(...)`; those that it has not are seen
    regions: Ints

    def take(self, at: Any) -> "Outlook":
        """Return what egos and helpers see in some of the decisions: those at `at`.

        `at` is an array of indices, or a mask, of the leading axis of all arrays.
        """
        unseen, added = self.unseen[at], self.added[at]
        return Outlook(unseen, added, self.to_zone_s[at], self.regions[at])

    def mean(self, values: Floats) -> Floats:
        """Return the means over a road's own regions of values, `(..., R)` or `(..., H, R)`."""
        regions = np.maximum(self.regions, 1)
        of_helpers = values.ndim > self.unseen.ndim
        return np.asarray(values.sum(axis=-1) / (regions[..., None] if of_helpers else regions))

    def of_helpers(self, places: Ints) -> "Outlook":
        """Return what the ego and helpers see, with the helpers reordered, chosen or repeated.

        `places`, `(..., H')`, says for each decision which of the H helpers here, by index from 0,
        stands at each of H' places.
        """
        return replace(self, added=np.take_along_axis(self.added, places[..., None], axis=-2))


@dataclass(frozen=True)
class ScheduleInputs:
    """Hold what the ego knows before it asks anybody, the input of a schedule.

    A schedule is the rule for whom to ask. Arrays are of decisions of any shape `(...)`, with H
    helpers, index h for helper h, and A actions. Values for a helper that may not be asked are
    arbitrary.
    """

    # the ego's intent, its probabilities of its actions, `(..., A)`; the fallback, such as all
    # alike, where its answer failed
    own: Floats
    entropy_nats: Floats  # entropy of `own` in nats, `(...)`: how unsure the ego is
    may_ask: Bools  # which helpers are in the radius and would answer, `(..., H)`
    range_m: Floats  # each helper's distance to the ego, m, `(..., H)`
    # each vehicle's distance to the centroid of the conflict zone, m, `(..., 1+H)`, the ego first
    distance_m: Floats
    # probability that request and reply are received within the decision window, `(..., H)`, by the
    # channel's model, if all who may be asked are asked; None if the schedule does not need it
    in_time: Floats | None = None
    # how much the ego sees of where a danger may come from, and what helpers would add; None if the
    # schedule does not need it
    outlook: Outlook | None = None
    # a random number in [0, 1), new at each decision, `(...)`; None if the schedule does not need
    # it
    lot: Floats | None = None


@runtime_checkable
class Schedule(Protocol):
    """Describe a schedule, the rule for whom the ego asks, by what asking each helper is worth.

    It is a pure function of arrays. The ego asks the helpers whose worth is above the threshold,
    those worth the most first, up to the number that its operating point (the settings of a
    decision) allows.
    """

    @property
    def needs(self) -> tuple[str, ...]:
        """Return what this schedule reads of `in_time`, `outlook` and `lot`.

        They are fields of `ScheduleInputs`: the probability of a reply in time, how much of the
        road is in view, and a random draw. Those that it does not name may be None.
        """

    @property
    def threshold(self) -> float | None:
        """Return the worth above which the ego asks, in the schedule's own unit; or None.

        An operating point, the settings that a decision depends on, may set another. None means
        that the schedule has no threshold, and a point may set none.
        """

    def worth(self, known: ScheduleInputs) -> Floats:
        """Return what asking each helper is worth, in a unit of the schedule's own, `(..., H)`.

        The unit is such as nats for a schedule by entropy. `known` has what the ego knows in
        decisions `(...)` before it asks. The result is `(..., 1)` if it is the same for all
        helpers. If helpers differ, it is NaN for one that may not be asked.
        """


@dataclass(frozen=True)
class Formula:
    """Make a schedule, a rule for whom the ego asks, of a function of what the ego knows.

    `formula` returns what asking each helper is worth, `(..., H)` or, if it is the same for all,
    `(..., 1)`, in a unit of its own; the ego asks those above `threshold`. `needs` names the
    optional fields of `ScheduleInputs` that it reads, and `by_presence` says whether what one
    helper is worth depends on which others may be asked.
    """

    # returns what asking each helper is worth, `(..., H)`, or `(..., 1)` if it is the same for all
    formula: Callable[[ScheduleInputs], Floats]
    # the worth above which the ego asks (`Schedule.threshold`), in the formula's own unit
    threshold: float | None = None
    needs: tuple[str, ...] = ()  # the optional fields of `ScheduleInputs` that the formula reads
    # whether what one helper is worth depends on which others may be asked. That of a schedule that
    # does not say may
    by_presence: bool = False

    def worth(self, known: ScheduleInputs) -> Floats:
        """Return the formula's worth of asking each helper, `(..., H)`, or `(..., 1)` for all.

        `known` has what the ego knows in decisions `(...)` before it asks.
        """
        return self.formula(known)


def never(inputs: ScheduleInputs) -> Floats:
    """Return a worth of minus infinity, `(..., 1)`, so that nobody is ever asked.

    It is the formula of schedule `never`; `inputs` is what the ego knows in decisions `(...)`.
    """
    return np.full((*inputs.entropy_nats.shape, 1), -np.inf)


def entropy(inputs: ScheduleInputs) -> Floats:
    """Return how unsure the ego is, in nats, as what asking anybody is worth, `(..., 1)`.

    It is the formula of schedule `entropy` (Eq. 3 of the paper that this harness follows): the
    entropy of the ego's intent, its probabilities of the actions. `inputs` is what the ego knows in
    decisions `(...)`.
    """
    return inputs.entropy_nats[..., None]


NEVER = "never"
FORMULAS = {"entropy": Formula(entropy), NEVER: Formula(never)}
PAPER = "entropy"  # its threshold is tau
ORACLE = "oracle"  # a bound that only a study of frozen scenes can play


def chosen(worth: Floats, threshold: float, may_ask: Bools, range_m: Floats, most: int) -> Bools:
    """Return a mask of the helpers that are asked, `(..., H)`: no more than `most` of them.

    Asking each is worth more than `threshold`. Those worth the most come first, and of equals the
    nearest.

    Args:
        worth: what a schedule says that asking each of H helpers is worth, `(..., H)`, or
            `(..., 1)` for all.
        threshold: in the same unit.
        may_ask: which helpers may be asked, `(..., H)`.
        range_m: each helper's distance to the ego, m, `(..., H)`.
        most: the largest number of helpers asked in one decision.
    """
    is_asked = may_ask & (worth > threshold)
    if most >= is_asked.shape[-1]:
        return is_asked
    by_range = np.where(is_asked, range_m, np.inf)
    order = np.lexsort((by_range, -np.where(is_asked, worth, -np.inf)), axis=-1)
    return is_asked & (np.argsort(order, axis=-1, kind="stable") < most)
