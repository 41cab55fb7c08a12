"""Whom the ego asks, and when: what a schedule knows before anybody is asked, and what asking is worth by it.

A schedule is one function of `Known` and one entry in `FORMULAS`, or a network that was learnt
(`learnt.py`); `schedules.py` knows all by name. It says what asking each helper is worth, in a unit of its
own. Of the helpers that are worth more than the operating point's threshold as many are asked as the point
allows, the most worth first, and of equals the nearest. `entropy` is the paper's (Eq. 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Outlook:
    """What the ego sees of the scenario's regions, and what it can tell that its helpers see; R regions.

    Attributes:
        unseen: share of each region that the ego does not see, `(..., R)`.
        added: share of each region that the ego does not see and each helper does, `(..., H, R)`: by the
            place of its last beacon, past what the ego knows to be in the way. NaN for a helper that is not
            there.
        to_zone_s: seconds until the ego is at the conflict zone at its speed, `(...)`; 0 from there on, and
            inf at a standstill.
    """

    unseen: Floats
    added: Floats
    to_zone_s: Floats

    def take(self, at: Any) -> "Outlook":
        """The outlooks at these places of the leading dimension."""
        return Outlook(self.unseen[at], self.added[at], self.to_zone_s[at])

    def of_helpers(self, places: Ints) -> "Outlook":
        """The same with the helpers of these places, `(..., H')`; one may come again."""
        return replace(self, added=np.take_along_axis(self.added, places[..., None], axis=-2))


@dataclass(frozen=True)
class Known:
    """What the ego knows of a decision before it asks. Of a helper it may not ask, anything may stand here.

    Attributes:
        own: the ego's intent, after the fallback, `(..., A)`.
        entropy_nats: its entropy, `(...)`.
        may_ask: who is in the radius and would answer, `(..., H)`.
        range_m: distance to the ego, `(..., H)`.
        distance_m: distance to the conflict zone, `(..., 1+H)`, the ego first.
        in_time: probability that request and reply cross and the reply is there in the window, `(..., H)`, as
            the channel's model has it for links like these, if all who may be asked are.
        outlook: what the ego sees, and what helpers would add.
        lot: a draw in [0, 1), new at each decision, `(...)`.
    """

    own: Floats
    entropy_nats: Floats
    may_ask: Bools
    range_m: Floats
    distance_m: Floats
    in_time: Floats | None = None
    outlook: Outlook | None = None
    lot: Floats | None = None


@runtime_checkable
class Schedule(Protocol):
    """A pure function of arrays."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Which of `in_time`, `outlook` and `lot` it looks at; others are None."""

    @property
    def threshold(self) -> float | None:
        """What asking has to be worth more than, unless the operating point says otherwise; None without."""

    def worth(self, known: Known) -> Floats:
        """What asking each helper is worth, `(..., H)`, or `(..., 1)` where it is the same for all.

        Where helpers differ, NaN for one that may not be asked.
        """


@dataclass(frozen=True)
class Formula:
    """The schedule that is one function of what is known."""

    formula: Callable[[Known], Floats]
    threshold: float | None = None
    needs: tuple[str, ...] = ()

    def worth(self, known: Known) -> Floats:
        """Whatever the function says."""
        return self.formula(known)


def never(known: Known) -> Floats:
    """Nobody is worth asking."""
    return np.full((*known.entropy_nats.shape, 1), -np.inf)


def always(known: Known) -> Floats:
    """Everybody is."""
    return np.full((*known.entropy_nats.shape, 1), np.inf)


def entropy(known: Known) -> Floats:
    """Entropy of the ego's intent, nats (paper Eq. 3)."""
    return known.entropy_nats[..., None]


def margin(known: Known) -> Floats:
    """1 less what the likeliest action has over the next: 0 sure, 1 undecided between two."""
    ranked = np.sort(known.own, axis=-1)
    lead: Floats = ranked[..., -1] - (ranked[..., -2] if ranked.shape[-1] > 1 else 0.0)
    return (1.0 - lead)[..., None]


def risk(known: Known) -> Floats:
    """Entropy, nats, times the share that the ego does not see of the region it sees least of."""
    assert known.outlook is not None
    unseen: Floats = np.max(known.outlook.unseen, axis=-1, initial=0.0)
    return (known.entropy_nats * unseen)[..., None]


def deadline(known: Known) -> Floats:
    """Entropy, nats, times the probability that the helper's reply is there in time."""
    assert known.in_time is not None
    return np.where(known.may_ask, known.entropy_nats[..., None] * known.in_time, np.nan)


def coverage(known: Known) -> Floats:
    """Mean share of the regions that the ego does not see and the helper does.

    Need times supply at each point of a region, as in Where2comm (Hu et al. 2022, arXiv 2209.12836).
    """
    assert known.outlook is not None
    regions = max(known.outlook.added.shape[-1], 1)
    return np.where(known.may_ask, np.sum(known.outlook.added, axis=-1) / regions, np.nan)


def random(known: Known) -> Floats:
    """A draw in [0, 1), so that a share of 1 less the threshold of the decisions asks."""
    assert known.lot is not None
    return known.lot[..., None]


FORMULAS = {
    "entropy": Formula(entropy),
    "never": Formula(never),
    "always": Formula(always),
    "margin": Formula(margin, 0.5),
    "risk": Formula(risk, 0.35, ("outlook",)),
    "deadline": Formula(deadline, 0.35, ("in_time",)),
    "coverage": Formula(coverage, 0.1, ("outlook",)),
    "random": Formula(random, 0.5, ("lot",)),
}
PAPER = "entropy"  # whose threshold is tau
ORACLE = "oracle"  # a bound, which only a study of frozen scenes can play


def chosen(worth: Floats, threshold: float, may_ask: Bools, range_m: Floats, most: int) -> Bools:
    """Who is asked, `(..., H)`: the `most` of those worth more than the threshold; of equals the nearest."""
    asked = may_ask & (worth > threshold)
    if most >= asked.shape[-1]:
        return asked
    by_range = np.where(asked, range_m, np.inf)
    order = np.lexsort((by_range, -np.where(asked, worth, -np.inf)), axis=-1)
    return asked & (np.argsort(order, axis=-1, kind="stable") < most)
