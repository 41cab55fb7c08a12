"""Correct success for the layouts' difficulty, which their trees know before any model is asked.

What two drivers and even actions do in all layouts of a dataset says how hard those are in which a
model was asked. `harness/core/covariate.py` has the rule.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from harness.core.arrays import Bools, Floats, Ints
from harness.core.covariate import corrected
from harness.core.statistics import LEVEL, Estimate, known_mean, mean_of
from harness.runs import estimates
from harness.runs.estimates import over_episodes
from harness.runs.grid import Grid
from harness.runs.headline import SUCCESS
from harness.runs.metric_names import ADJUSTED, BASELINE, GAINS
from harness.runs.records import Episode, Score
from harness.runs.success import Success, by_condition

FILE = "difficulty.csv"
REFERENCES = ("local-view", "cruise", "uniform")  # that ask no model


class Layout(Struct, frozen=True):
    """Hold how hard one start situation is: the success of three policies without a model in it.

    A layout is a drawn start situation of a scenario, here that of the episode of this number;
    `danger` is the side from which the hidden vehicle comes. The policies are two rules that drive,
    `local-view` (by what the ego alone sees) and `cruise` (never brakes), with 1 for success and
    else 0, and actions drawn at random, `uniform`, with a probability. It is a line of
    `difficulty.csv`.
    """

    episode: int  # the episode's number
    # where the vehicle comes from that would meet the ego: a sector; `none` without one
    danger: str
    local_view: float  # 1 if the driver `local-view` succeeds, else 0
    cruise: float  # the same of the driver `cruise`
    uniform: float  # with what probability it succeeds if all actions are equally likely

    def __post_init__(self) -> None:
        if not all(0 <= success <= 1 for success in (self.local_view, self.cruise, self.uniform)):
            raise ValueError(f"episode {self.episode}: a success that is not from 0 to 1")


@dataclass(frozen=True)
class Pool:
    """Hold how hard all N layouts are that a run's E layouts were sampled from.

    By it a run's success is corrected for the luck of an easy or a hard sample. A layout is one
    start situation of a scenario, and has one episode. How hard it is, is known from the success of
    K reference policies that need no model, `known` (N, K). `dangerous`, (N,), says whether it has
    a danger, and `answered`, (E,), has the index among the N of each of the run's. A danger is a
    vehicle that would meet an ego which keeps its speed.
    """

    known: Floats  # success of each reference in each layout, 0 to 1, (N, K)
    dangerous: Bools  # whether each layout has a danger, (N,)
    answered: Ints  # index among the N of each of the run's layouts, (E,)

    @classmethod
    def of(cls, layouts: Sequence[Layout], episodes: Iterable[int]) -> "Pool":
        """Return how hard a run's layouts are among all of a dataset, given a record of each.

        A layout is one start situation of a scenario, with one episode. `layouts` has the success
        of rules without a model in each; `episodes` are the numbers of those that the run
        evaluated.
        """
        places = {layout.episode: place for place, layout in enumerate(layouts)}
        return cls(
            np.array([(each.local_view, each.cruise, each.uniform) for each in layouts]),
            np.array([each.danger != "none" for each in layouts]),
            np.array([places[episode] for episode in episodes]),
        )

    def difference(
        self, success: Success, a: Floats, b: Floats, level: float = LEVEL
    ) -> Estimate | None:
        """Return the difference in success a - b, corrected for how hard the run's layouts are.

        `a` and `b` are the success of the same episodes, (S, E), by S seeds of the channel's random
        draws and E episodes, and are paired by episode. `success` says how episodes are averaged,
        `level` is the confidence of the interval. None if it cannot be corrected, as with too few
        episodes. A layout is one start situation of a scenario.
        """

        def plain(part: Bools) -> Estimate:
            return estimates.difference(SUCCESS, [(a[:, part].T, b[:, part].T)], level)

        return self._corrected(success, plain, known_mean(a - b, 0), -1.0, level)

    def estimate(self, success: Success, values: Floats) -> Estimate | None:
        """Return the mean success, corrected for how hard the run's layouts are.

        `values` are the success of its episodes, (S, E), by S seeds of the channel's random draws
        and E episodes; `success` says how episodes are averaged. None if it cannot be corrected, as
        with too few episodes. A layout is one start situation of a scenario.
        """

        def plain(part: Bools) -> Estimate:
            return over_episodes(SUCCESS, values[:, part])

        return self._corrected(success, plain, known_mean(values, 0), 0.0, LEVEL)

    def _corrected(
        self,
        success: Success,
        plain: Callable[[Bools], Estimate],
        values: Floats,
        least: float,
        level: float,
    ) -> Estimate | None:
        """Correct each half of its own where success is balanced;
        one that cannot be stays as it is. Layouts of a cluster, which are no random sample, are not
        corrected.
        """
        if success.clusters is not None:
            return None
        parts, covariates = success.parts, self.known[self.answered]
        pools = [self.known]
        if len(parts) > 1:
            pools = [self.known[self.dangerous], self.known[~self.dangerous]]
        estimates = [plain(part) for part in parts]
        better = [
            corrected(estimate, values[part], covariates[part], pool, least, level)
            for estimate, part, pool in zip(estimates, parts, pools, strict=True)
        ]
        if not any(better):
            return None
        chosen = [new or old for new, old in zip(better, estimates, strict=True)]
        return mean_of(chosen) if len(chosen) > 1 else chosen[0]


def adjusted_scores(
    grid: Grid, episodes: Sequence[Episode], layouts: Sequence[Layout]
) -> Iterator[Score]:
    """Yield the scores of success and of its gains that are adjusted for layout difficulty.

    A layout is one start situation of a scenario. A gain is a condition's success less that of the
    condition without a radio. A condition is a named set of settings of the radio, of asking
    helpers and of fusing their messages.

    Args:
        grid: the conditions, seeds and episodes of the run.
        episodes: the run's, in the order of the grid: by condition, seed and episode.
        layouts: all layouts that the run's are a sample of, with the success of reference drivers.
    """
    success, values = by_condition(grid, episodes)
    pool = Pool.of(layouts, grid.episodes)
    for by in success.ways:
        for name, of_condition in values.items():
            figures = {by.metric: pool.estimate(by, of_condition)}
            if BASELINE in values and name != BASELINE:
                figures[GAINS[by.metric]] = pool.difference(by, of_condition, values[BASELINE])
            for metric, estimate in figures.items():
                if estimate:
                    yield Score.of(name, ADJUSTED[metric], estimate, "episodes")
