"""The metric by which runs are read, and the condition:
success balanced over danger and none, or plain.

It is balanced where layouts are of both kinds, as a run's rows of `BALANCED` say.
"""

from collections.abc import Container, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from harness.runs.records import Score

SUCCESS, BALANCED = "success_rate", "balanced_success_rate"
ANY_TIME = "any time"  # the kind of an interval over episodes that holds at every look
# the kind of an interval of differences, all of whose parts are taken together
PAIRED = "paired episodes"
IN_WORDS = {SUCCESS: "success", BALANCED: "balanced success"}


class Scored(Protocol):
    """Describe what has scores, one for each metric and condition: a run, or several together.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """

    @property
    def scores(self) -> "Sequence[Score]": ...


def headline_metric(*names: Container[str]) -> str:
    """Return the name of the metric by which runs are read, the headline metric.

    `names` has for each run the names of its metrics. It is balanced success, the mean of success
    with a danger and without, if every run has that; otherwise plain success. A danger is a vehicle
    that would meet an ego which keeps its speed.
    """
    return BALANCED if all(BALANCED in each for each in names) else SUCCESS


def headline_of(*runs: Scored) -> str:
    """Return the name of the metric by which some runs or suites are read, the headline metric.

    It is balanced success, the mean of success with a danger and without, if all of them have a
    value of it; otherwise plain success. A danger is a vehicle that would meet an ego which keeps
    its speed.
    """
    names_by_run = []
    for run in runs:
        names_by_run.append({score.metric for score in run.scores if score.value is not None})
    return headline_metric(*names_by_run)


def best_of(success: Mapping[str, float], radios: Container[str], doubted: Container[str]) -> str:
    """Return the name of the condition under which a run does best; empty if there is none.

    A condition is a named set of settings that a run scores. It is that with the highest success,
    of equals the first. One with a warning does not count if another one with a radio is left.

    Args:
        success: success from 0 to 1 by condition.
        radios: names of the conditions with a radio.
        doubted: names of the conditions with a warning, such as that their radio is unvalidated.
    """
    trusted = [name for name in success if name not in doubted]
    counted = trusted if any(name in radios for name in trusted) else success
    return max(counted, key=lambda name: success[name], default="")
