"""Whether frozen episodes rank the reference drivers as live driving on the same seeds does."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from harness.core.arrays import Bools
from harness.core.errors import UserError, printable
from harness.core.parallel import spread
from harness.core.statistics import Estimate, paired_difference, rate_interval
from harness.dataset.load import Dataset
from harness.evaluate.success import driver_choices, judge_choices, table
from harness.world.drivers import DRIVERS
from harness.world.reference import drive_all


@dataclass(frozen=True)
class Standing:
    """One driver, frozen and live.

    Attributes:
        frozen: success by the rule of `harness.evaluate.success`.
        live: success in the simulator.
        difference_points: frozen minus live, in percentage points, paired by episode.
        agreement: share of episodes with the same result.
    """

    frozen: Estimate
    live: Estimate
    difference_points: Estimate
    agreement: Estimate


def rank(dataset: Dataset, workers: int, progress: Callable[[int], None]) -> dict[str, Standing]:
    """Each driver's standing over the dataset's episodes; every one of them is driven again in closed loop.

    Raises:
        UserError: the dataset was built with other actions than the scenario has.
    """
    scenario = dataset.scenario
    if dataset.actions != scenario.actions:
        raise UserError(
            f"dataset {printable(dataset.path)} was built with other actions than are driven here; "
            "build it again to compare"
        )
    seeds = {s.record["episode"]: s.record["episode_seed"] for s in dataset.scenes}
    live = spread(partial(drive_all, scenario), seeds.values(), workers, progress)
    return {
        driver: _standing(frozen_success(dataset, driver), np.array([o[driver].success for o in live]))
        for driver in DRIVERS
    }


def frozen_success(dataset: Dataset, driver: str) -> Bools:
    """Success of each frozen episode if a reference driver takes its decisions, `(E,)`."""
    return judge_choices(table(dataset), driver_choices(dataset, driver)).success


def ranks_agree(standings: dict[str, Standing]) -> bool:
    """Whether no pair of drivers stands one way frozen and the other way live; a tie goes with either."""
    return all(
        (a.frozen.value - b.frozen.value) * (a.live.value - b.live.value) >= 0
        for a, b in combinations(standings.values(), 2)
    )


def _standing(frozen: Bools, live: Bools) -> Standing:
    return Standing(
        rate_interval(frozen.astype(float)),
        rate_interval(live.astype(float)),
        paired_difference(np.where(frozen, 100.0, 0.0), np.where(live, 100.0, 0.0)),
        rate_interval((frozen == live).astype(float)),
    )
