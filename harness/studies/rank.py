"""Whether frozen episodes rank the reference drivers as live driving on the same seeds does."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.core.parallel import Workers
from harness.core.statistics import Estimate, rate_difference, rate_interval
from harness.dataset.load import Dataset
from harness.world.drivers import DRIVERS
from harness.world.reference import drive_apart


@dataclass(frozen=True)
class Standing:
    """One driver, frozen and live."""

    frozen: Estimate  # success in the trees
    live: Estimate  # success in the simulator
    difference_points: Estimate  # frozen minus live, in percentage points, paired by episode
    agreement: Estimate  # share of episodes with the same result


def rank(dataset: Dataset, workers: Workers, progress: Callable[[int], None]) -> dict[str, Standing]:
    """Return each driver's standing over the dataset's episodes, every one of which is driven again."""
    live = drive_apart(dataset.scenario, dataset.seeds, workers, progress)
    frozen = dataset.reference_success()
    return {
        driver: _standing(frozen[driver], np.array([o[driver].success for o in live])) for driver in DRIVERS
    }


def _standing(frozen: Floats, live: Bools) -> Standing:
    difference = rate_difference(frozen, live.astype(float))
    points = {end: 100 * getattr(difference, end) for end in ("value", "low", "high")}
    return Standing(
        rate_interval(frozen),
        rate_interval(live.astype(float)),
        replace(difference, **points),
        rate_interval((frozen == live).astype(float)),
    )
