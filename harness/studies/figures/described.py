"""What a study's figures hold, and what draws them: as charts of its page, or as pictures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, TypeVar

from harness.core.arrays import Floats
from harness.core.statistics import Estimate
from harness.report.document import Chart

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Line = Literal["-", "--", ":", ""]  # solid, dashed, dotted, none
DrawnT = TypeVar("DrawnT", covariant=True)


@dataclass(frozen=True)
class Steps:
    """Describe a step curve of a figure, whose points ascend in x and y.

    `x` is where each step begins, in the axis's unit, and `y` its height. `label` is the curve's
    name in the legend, and `name` is written beside its last point. `colour` is a hex code, `line`
    how the steps are joined, and `marker` one of `MARKERS` at each, `size` points wide.
    """

    label: str  # the curve's name in the legend; empty for none
    x: Sequence[float] | Floats  # where each step begins, ascending, in the axis's unit
    y: Sequence[float] | Floats  # the height of each step, ascending
    colour: str
    line: Line = "-"  # empty for points alone
    marker: str = ""  # empty for a line alone
    size: float = 4.0  # of a marker, in points
    name: str = ""  # beside the last place


@dataclass(frozen=True)
class Rows:
    """Describe a panel of estimates: a row for each of `names`, and in it one of each series.

    A series is such as the estimates of one model: `series` has them by its name, in the order of
    the rows. An unknown one is None; each is drawn times `scale`, 100 for percent; `quantity` is
    what it is, with its unit.
    """

    quantity: str  # along the panel, with its unit
    names: Sequence[str]  # of the rows, from top to bottom
    series: Mapping[str, Sequence[Estimate | None]]  # by its name, an estimate for each row
    scale: float = 100.0  # what an estimate is multiplied with: 100 for percent


class Draws(Protocol[DrawnT]):
    """Draw figures of studies: the module `charts` for a page, or `pictures` with matplotlib."""

    def operating_points(self, core: "pd.DataFrame", paper: "pd.DataFrame | None" = None) -> DrawnT:
        """Draw latency, success and messages of the operating points, with 95 % intervals.

        An operating point is everything a decision depends on besides scene and model. `core` has
        the rows of a study's summary about them, one for each of them and each metric. `paper` has
        values of the paper that this harness repeats, to draw beside them: `low` and `high` by
        `panel` (the paper's figure), `condition`, `value` and `metric`, equal for a single value;
        None to draw none.
        """
        ...

    def along(
        self,
        panels: "Sequence[pd.DataFrame]",
        paper: "pd.DataFrame | None" = None,
        colours: Mapping[str, str] | None = None,
    ) -> DrawnT:
        """Draw success along an axis, a panel for each axis, with loss or trigger rate beside it.

        An axis is what a sweep varies, such as packet loss; the trigger rate is the share of
        decisions in which the ego asks helpers. Panels are parts of a study's summary, and each may
        have several sources (runs). `paper` is the table of the paper's values, None to draw none;
        with it, its best range of tau, the entropy threshold, is drawn. `colours` gives colours to
        conditions (operating points); None for the usual ones. If there are several sources, each
        curve has a colour of its own.
        """
        ...

    def heat_map(
        self,
        panels: Mapping[str, Floats],
        rows: Sequence[str],
        columns: Sequence[str],
        row: str = "",
        column: str = "",
    ) -> DrawnT:
        """Draw heat maps of percentages, one panel for each array of `panels`, by its title.

        An array is (R, C), of R rows and C columns, with values from 0 to 100. `rows` and `columns`
        are the names along both axes, `row` and `column` the titles of the axes.
        """
        ...

    def fronts(self, panels: Sequence[tuple[str, str, Sequence[Steps]]], success: str) -> DrawnT:
        """Draw success in percent against a cost, as step curves, side by side.

        Each of `panels` is its title, the label of the cost with its unit, and its curves, whose x
        is the cost and y success in percent; `success` is the metric's name for people.
        """
        ...

    def intervals(self, panels: Sequence[Rows], colours: Mapping[str, str]) -> DrawnT:
        """Draw estimates with their 95 % intervals, a panel for each of `panels`.

        A series of estimates has a colour, by its name in `colours`, and a marker. Where an
        interval is unknown, the point stands alone.
        """
        ...

    def either(
        self, picture: "Callable[[], Figure]", panels: Callable[[], Sequence[Chart]]
    ) -> DrawnT:
        """Draw what one study alone has: call the function that draws it this way."""
        ...
