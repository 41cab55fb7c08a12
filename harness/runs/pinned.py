"""Differences of success as older runs state them, and as what is pinned to these computes them.

Each half of each family has an interval of its own (`rate_difference`), and these are combined.
Taken together, the same differences have a narrower one: `success.mean_difference`.
"""

from harness.core.statistics import Estimate, mean_of, rate_difference
from harness.runs import success
from harness.runs.folder import Run
from harness.runs.headline import BALANCED
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.records import Score
from harness.runs.success import Pairs

KIND = "episodes"  # of its intervals


def mean_difference(pairs: Pairs) -> Estimate:
    """Return the mean difference in success a - b by the rules of the oldest runs, to check these.

    They are version 1 of the rules for figures; `harness.core.versions.FIGURES` has today's. It is
    the mean over families; a family is the scenes of one scenario. `pairs` has for each its rule of
    how success is averaged and the success a and b of its episodes, (S, E) each, by S seeds of the
    channel's random draws and E episodes. The interval of each half of a family, with a danger or
    without, is computed apart, and these are combined. Of clusters of episodes, which those rules
    did not know, it is that by today's.
    """
    if success.clusters_of([rule for rule, _, _ in pairs]) is not None:
        return success.mean_difference(pairs)
    families = []
    for rule, a, b in pairs:
        halves = [rate_difference(a[:, part].T, b[:, part].T) for part in rule.parts]
        families.append(mean_of(halves) if len(halves) > 1 else halves[0])
    return mean_of(families) if len(families) > 1 else families[0]


def gain(run: Run, score: Score) -> Score:
    """Return a run's gain over the condition without a radio by the oldest rules, to check it.

    A gain is the difference in success of the same episodes. The rules are version 1 of those for
    figures; `harness.core.versions.FIGURES` has today's. `score` is a score of the run whose
    condition and metric are taken; its value is not. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    rule, values = success.by_condition(run.grid, run.episodes)
    counted = rule if score.metric == GAINS[BALANCED] else rule.plain
    estimate = mean_difference([(counted, values[score.condition], values[BASELINE])])
    return Score.of(score.condition, score.metric, estimate, KIND)
