"""Define schedules beside the paper's: by doubt, by what helpers would add, by lot.

A schedule decides whom the ego asks. Each function here returns what asking each of H helpers is
worth, `(..., H)` with an axis for each leading one of its inputs (such as decisions), or `(..., 1)`
where it is the same for all helpers. Those worth more than the schedule's threshold are asked.
"""

import numpy as np

from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.arrays import Floats


def always(inputs: ScheduleInputs) -> Floats:
    """Return an infinite worth of asking, the same for every helper, `(..., 1)`.

    It is a schedule, a rule for whom the ego asks: those whose worth is above a threshold. So all
    helpers are always asked, up to the number that the settings allow. `inputs` has what the ego
    knows before it asks, with leading axes `(...)`.
    """
    return np.full((*inputs.entropy_nats.shape, 1), np.inf)


def margin(inputs: ScheduleInputs) -> Floats:
    """Return as the worth of asking how undecided the ego is between its two likeliest actions.

    It is 1 minus the lead of the likeliest action's probability over the next, `(..., 1)`, the same
    for every helper: 0 for an ego that is certain, 1 for one undecided between two actions.
    `inputs` has what the ego knows before it asks, with leading axes `(...)`.
    """
    ranked = np.sort(inputs.own, axis=-1)
    difference: Floats = ranked[..., -1] - (ranked[..., -2] if ranked.shape[-1] > 1 else 0.0)
    return (1.0 - difference)[..., None]


def risk(inputs: ScheduleInputs) -> Floats:
    """Return as the worth of asking the ego's doubt times how much it does not see, `(..., 1)`.

    Doubt is the entropy in nats of the ego's intent, its probabilities of actions; the other factor
    is the unseen share, 0 to 1, of the region that it sees least of. Regions are where a danger may
    come from: left, right, oncoming. The worth is the same for every helper. `inputs` has what the
    ego knows before it asks, with leading axes `(...)`.
    """
    assert inputs.outlook is not None
    unseen: Floats = np.max(inputs.outlook.unseen, axis=-1, initial=0.0)
    return (inputs.entropy_nats * unseen)[..., None]


def deadline(inputs: ScheduleInputs) -> Floats:
    """Return as the worth of asking the ego's doubt times the chance of a timely reply, `(..., H)`.

    Doubt is the entropy in nats of the ego's intent, its probabilities of actions. The chance is
    the probability that the request reaches the helper, and its reply the ego, before the ego
    decides. The worth is NaN for one of the H helpers that may not be asked. `inputs` has what the
    ego knows before it asks, with leading axes `(...)`.
    """
    assert inputs.in_time is not None
    return np.where(inputs.may_ask, inputs.entropy_nats[..., None] * inputs.in_time, np.nan)


def coverage(inputs: ScheduleInputs) -> Floats:
    """Return as the worth of asking how much a helper sees that the ego does not, `(..., H)`.

    It is a share, 0 to 1, of each region where a danger may come from (left, right, oncoming),
    averaged over regions; NaN for one of the H helpers that may not be asked. This is need times
    supply at each point of a region, as in Where2comm (Hu et al. 2022, arXiv 2209.12836). `inputs`
    has what the ego knows before it asks, with leading axes `(...)`.
    """
    assert inputs.outlook is not None
    return np.where(inputs.may_ask, inputs.outlook.mean(inputs.outlook.added), np.nan)


def random(inputs: ScheduleInputs) -> Floats:
    """Return a uniform draw in [0, 1) as the worth of asking, the same of every helper, `(..., 1)`.

    It is new at each decision, and one of the `inputs`, which have leading axes `(...)`. So the ego
    asks in a share of 1 minus the threshold of its decisions.
    """
    assert inputs.lot is not None
    return inputs.lot[..., None]


ALWAYS = Formula(always)
MARGIN = Formula(margin, 0.5)
RISK = Formula(risk, 0.35, ("outlook",))
DEADLINE = Formula(deadline, 0.35, ("in_time",), by_presence=True)
COVERAGE = Formula(coverage, 0.1, ("outlook",))
RANDOM = Formula(random, 0.5, ("lot",))
