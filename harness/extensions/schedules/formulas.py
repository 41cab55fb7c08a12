"""Define schedules beside the paper's: by doubt, by what helpers would add, by lot."""

import numpy as np

from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.arrays import Floats


def always(known: ScheduleInputs) -> Floats:
    """Return infinite worth for every helper, so that all are always asked: `(..., 1)`."""
    return np.full((*known.entropy_nats.shape, 1), np.inf)


def margin(known: ScheduleInputs) -> Floats:
    """Return 1 minus the lead of the likeliest action's probability over the next, `(..., 1)`.

    It is 0 for a certain intent, and 1 for one undecided between two actions.
    """
    ranked = np.sort(known.own, axis=-1)
    lead: Floats = ranked[..., -1] - (ranked[..., -2] if ranked.shape[-1] > 1 else 0.0)
    return (1.0 - lead)[..., None]


def risk(known: ScheduleInputs) -> Floats:
    """Return the entropy in nats times the unseen share of the least visible region, `(..., 1)`."""
    assert known.outlook is not None
    unseen: Floats = np.max(known.outlook.unseen, axis=-1, initial=0.0)
    return (known.entropy_nats * unseen)[..., None]


def deadline(known: ScheduleInputs) -> Floats:
    """Return the entropy in nats times the probability that a reply comes in time, `(..., H)`.

    It is NaN for a helper that may not be asked.
    """
    assert known.in_time is not None
    return np.where(known.may_ask, known.entropy_nats[..., None] * known.in_time, np.nan)


def coverage(known: ScheduleInputs) -> Floats:
    """Return the mean share of the regions that a helper sees and the ego does not, `(..., H)`.

    It is NaN for a helper that may not be asked. This is need times supply at each point of a
    region, as in Where2comm (Hu et al. 2022, arXiv 2209.12836).
    """
    assert known.outlook is not None
    regions = max(known.outlook.added.shape[-1], 1)
    return np.where(known.may_ask, np.sum(known.outlook.added, axis=-1) / regions, np.nan)


def random(known: ScheduleInputs) -> Floats:
    """Return a uniform draw in [0, 1), `(..., 1)`, as what asking is worth.

    So the ego asks in a share of 1 minus the threshold of its decisions.
    """
    assert known.lot is not None
    return known.lot[..., None]


ALWAYS = Formula(always)
MARGIN = Formula(margin, 0.5)
RISK = Formula(risk, 0.35, ("outlook",))
DEADLINE = Formula(deadline, 0.35, ("in_time",), by_presence=True)
COVERAGE = Formula(coverage, 0.1, ("outlook",))
RANDOM = Formula(random, 0.5, ("lot",))
