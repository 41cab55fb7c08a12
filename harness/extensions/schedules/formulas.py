"""Define schedules beside the paper's: by doubt, by what helpers would add, by lot."""

import numpy as np

from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.arrays import Floats


def always(inputs: ScheduleInputs) -> Floats:
    """Return infinite worth for every helper, so that all are always asked: `(..., 1)`.

    `inputs` has what a schedule may use, with leading axes `(...)`; what is worth the same of each
    helper has one column.
    """
    return np.full((*inputs.entropy_nats.shape, 1), np.inf)


def margin(inputs: ScheduleInputs) -> Floats:
    """Return 1 minus the lead of the likeliest action's probability over the next, `(..., 1)`.

    It is 0 for a certain intent, and 1 for one undecided between two actions.
    """
    ranked = np.sort(inputs.own, axis=-1)
    difference: Floats = ranked[..., -1] - (ranked[..., -2] if ranked.shape[-1] > 1 else 0.0)
    return (1.0 - difference)[..., None]


def risk(inputs: ScheduleInputs) -> Floats:
    """Return the entropy in nats times the unseen share of the least visible region, `(..., 1)`."""
    assert inputs.outlook is not None
    unseen: Floats = np.max(inputs.outlook.unseen, axis=-1, initial=0.0)
    return (inputs.entropy_nats * unseen)[..., None]


def deadline(inputs: ScheduleInputs) -> Floats:
    """Return the entropy in nats times the probability that a reply comes in time, `(..., H)`.

    It is NaN for one of the H helpers that may not be asked.
    """
    assert inputs.in_time is not None
    return np.where(inputs.may_ask, inputs.entropy_nats[..., None] * inputs.in_time, np.nan)


def coverage(inputs: ScheduleInputs) -> Floats:
    """Return the mean share of the regions that a helper sees and the ego does not, `(..., H)`.

    It is NaN for one of the H helpers that may not be asked. This is need times supply at each
    point of a region, as in Where2comm (Hu et al. 2022, arXiv 2209.12836).
    """
    assert inputs.outlook is not None
    regions = max(inputs.outlook.added.shape[-1], 1)
    return np.where(inputs.may_ask, np.sum(inputs.outlook.added, axis=-1) / regions, np.nan)


def random(inputs: ScheduleInputs) -> Floats:
    """Return a uniform draw in [0, 1), `(..., 1)`, as what asking is worth.

    So the ego asks in a share of 1 minus the threshold of its decisions.
    """
    assert inputs.lot is not None
    return inputs.lot[..., None]


ALWAYS = Formula(always)
MARGIN = Formula(margin, 0.5)
RISK = Formula(risk, 0.35, ("outlook",))
DEADLINE = Formula(deadline, 0.35, ("in_time",), by_presence=True)
COVERAGE = Formula(coverage, 0.1, ("outlook",))
RANDOM = Formula(random, 0.5, ("lot",))
