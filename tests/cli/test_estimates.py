"""Numbers as people read them."""

import math

import numpy as np

from harness.core.figures import interval
from harness.runs.metrics import over_episodes


def test_an_interval_that_nobody_knows_is_a_dash():
    assert interval(0.5, 0.4, 0.6, 100) == "50.0 [40.0, 60.0]"
    assert interval(0.5, math.nan, math.nan, 100) == "50.0 [–, –]"
    assert interval(math.nan, math.nan, math.nan, 1) == "– [–, –]"


def test_no_interval_reaches_where_its_metric_cannot_be():
    rare = np.zeros((1, 40))
    rare[0, 0] = 1.0
    assert over_episodes("other_crashes_per_episode", rare).low == 0.0
    losses = np.where(np.arange(40) < 39, 0.0, 0.5)[None]
    assert over_episodes("effective_loss", losses).low == 0.0
