"""Success on frozen scenes and in closed loop, paired by episode;
also that of the reference drivers.
"""

from collections.abc import Callable

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.parallel import Workers
from harness.core.statistics import Estimate
from harness.dataset.load import Dataset
from harness.runs.estimates import difference, over_episodes
from harness.runs.headline import SUCCESS
from harness.world.drivers import drivers_of

COMPARED = ("frozen", "closed", "difference", "agreement")


def compared(frozen: Floats, closed: Floats, clusters: Ints | None = None) -> dict[str, Estimate]:
    """Compare success of the same episodes on frozen scenes and in closed loop, (S, E) each.

    On frozen scenes a decision tree says what follows an action; in closed loop the simulator does.
    `frozen` and `closed` are 1 for success or 0; the axes are S channel seeds and E episodes. The
    result has, by the names in `COMPARED`, success in both, their difference, and the share of
    episodes that end alike, each with an interval over episodes, or over their `clusters`, (E,), if
    they have some.
    """
    alike = (frozen == closed).astype(float)
    return {
        "frozen": over_episodes(SUCCESS, frozen, clusters),
        "closed": over_episodes(SUCCESS, closed, clusters),
        "difference": difference(SUCCESS, [(frozen.T, closed.T)], clusters=clusters),
        "agreement": over_episodes("agreement_rate", alike, clusters),
    }


def rank(
    dataset: Dataset, workers: Workers, progress: Callable[[int], None]
) -> dict[str, dict[str, Estimate]]:
    """Drive a dataset's episodes with each reference driver, and compare with its frozen success.

    It checks whether both worlds agree. A reference driver is a rule that decides without a model.
    Returned are by driver's name the estimates of `compared`, by theirs: success in frozen
    (recorded) scenes and in closed loop (simulated), their difference, and the share of episodes
    that end alike. `workers` are processes or a cluster, and `progress` is called with the number
    of episodes just driven.
    """
    from harness.world.reference import drive_apart

    ends = drive_apart(dataset.scenario, dataset.seeds, workers, progress)
    frozen = dataset.reference_success()
    standings = {}
    for driver in drivers_of(dataset.scenario):
        closed = np.array([float(of_episode[driver].success) for of_episode in ends])
        standings[driver] = compared(frozen[driver][None], closed[None], dataset.clusters)
    return standings
