"""What a metric is: its name, meaning, unit and function."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from harness.core.arrays import Floats
from harness.core.figures import PERCENT, Unit
from harness.runs import reliability
from harness.runs.records import Answer, AnswerFacts, Episode, Role

World = Literal["frozen", "closed-loop"]
Better = Literal["higher", "lower", "neither"]
Answers = Sequence[Answer | AnswerFacts]
MS, SECONDS, METRES = Unit("ms"), Unit("s", 2), Unit("m")
NATS = Unit("nats", 3)
COUNT, MEAN_COUNT, SCORE = Unit(decimals=1), Unit(decimals=2), Unit(decimals=3)


class Columns(Protocol):
    """Describe a table of n decisions: `table[name]` is a column (n,), NaN where unknown."""

    def __getitem__(self, name: str, /) -> Floats: ...


@dataclass(frozen=True)
class Metric:
    """Define one metric, with values of 0 or more, by its name, meaning, unit and function.

    The function is one of these: `decisions` takes a table of n decisions and returns a value each,
    (n,), whose mean (sum, if `total`) is the episode's; `episodes` takes an episode's record and
    returns its value; `answers` takes the n answers of a `role` and returns a value each; `pooled`
    computes one figure of all decisions together. `percentile` is that of their latencies, and
    `halves` names two metrics, with a danger and without, whose mean it is. One without any is
    computed where `summary.csv` is made.

    `better` says which change is better (`higher`, `lower`, `neither`), `interval` whether it is a
    share (`rate`) or a mean, and `most` is the greatest value. `primary` ones are those that
    comparisons of runs are judged by. `world` names the only kind of run that has it; an `optional`
    one has no row where it is unknown, `half` says that it is of a part of the episodes, and a
    `superseded` one is left out of pages. `corrects` names the metric that it corrects for the
    difficulty of start situations, and `behind` the one whose rows its own follow. `label` is the
    name for people.
    """

    name: str  # its name in tables, with the unit at the end
    meaning: str  # its meaning, in words for people
    unit: Unit  # how it is written
    better: Better  # which change of it is better
    # `rate` for a share of events, whose interval is Wilson's; `mean` for Student's t
    interval: Literal["rate", "mean"] = "mean"
    most: float = math.inf  # the greatest value that it can have, such as 1 for a share
    # whether comparisons of runs are judged by it, with p-values corrected for multiple testing;
    # all others are exploratory
    primary: bool = False
    label: str = ""  # its name for people; by default the name with spaces
    # takes a table of n decisions and returns its values, (n,), whose mean is the episode's
    decisions: Callable[[Any], Floats] | None = None
    # takes an episode's record and returns its value; None where unknown
    episodes: Callable[[Episode], Any] | None = None
    # takes the n answers of one role and returns its values, (n,); NaN where unknown
    answers: Callable[[Answers], Floats] | None = None
    # role whose answers it is of: `ego`, `helper`, or `merge` (the ego after it heard messages)
    role: Role | None = None
    percentile: int | None = None  # the percent of all decisions whose latency is at most so long
    # computes a figure of all decisions together, which is no mean, such as `reliability.coverage`
    pooled: reliability.Figure | None = None
    total: bool = False  # whether an episode has the sum over its decisions instead of the mean
    # the only kind of run that knows it, `frozen` (recorded scenes) or `closed-loop`; None for both
    world: World | None = None
    optional: bool = False  # whether a run in which it is nowhere known has no row of it
    half: bool = False  # whether it is of the episodes with a danger alone, or of those without
    # names of two metrics whose mean it is: of the episodes with a danger, and of those without
    halves: tuple[str, ...] = ()
    # name of the metric that it corrects, where two runs are compared, by how hard start situations
    # are; empty for none
    corrects: str = ""
    # whether another has taken its place: tables and, where it is still computed, comparisons keep
    # it, and pages leave it out
    superseded: bool = False
    # of an extension that ships: the metric behind whose rows its own stand
    behind: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.name.replace("_", " "))

    @property
    def compared(self) -> bool:
        """Return whether two runs are compared in the metric.

        It is so if it has a value for each episode or over all decisions.
        """
        ways = (
            self.decisions,
            self.episodes,
            self.percentile,
            self.pooled,
            self.halves,
            self.corrects,
        )
        return any(ways)


def decision_share(
    name: str, meaning: str, column: str, better: Better = "lower", **more: Any
) -> Metric:
    """Build the metric of a share of decisions, one column of their table.

    `name`, `meaning`, `better` and `more` are fields of `Metric`; `column` names the column, which
    is 1 or 0 (true or false) for each decision, NaN where unknown.
    """
    return Metric(name, meaning, PERCENT, better, "rate", 1.0, decisions=of_column(column), **more)


def of_column(name: str) -> Callable[[Columns], Floats]:
    """Return a function that takes a table of n decisions and returns its column `name`, (n,).

    It is for metrics that are one column.
    """
    return lambda d: d[name]
