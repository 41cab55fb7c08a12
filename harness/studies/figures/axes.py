"""What figures of studies share: plain axes, letters, intervals, and the paper's values."""

from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report.drawing.colours import COLOURS, INK, PALE, conditions
from harness.runs.headline import headline_metric

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Curve = tuple[str, str]  # a source and a condition
ROOM_IN = 0.5  # for names below a figure, in its height
CLOUD_MS = 510.0  # the paper's cloud comparator, which it cites and nobody can run
BEST_BAND = (0.65, 0.70)  # of tau, the paper's
# of success
BESIDE = {"size": ("effective_loss", "packet loss"), "tau": ("trigger_rate", "trigger rate")}


def paper_values(
    marks: "pd.DataFrame | None", panel: str, metric: str, **place: str
) -> "pd.DataFrame":
    """Return the paper's values of a metric, to draw beside those of a run.

    The paper is the one whose study this harness repeats. `marks` is the table of all of its
    values; None gives no rows. `panel` names one of its sweeps, such as over packet loss; `place`
    selects rows by further columns, such as `condition`. Columns are `value` (of what the panel
    varies), `low` and `high`, in the metric's unit.
    """
    import pandas as pd

    if marks is None:
        return pd.DataFrame(columns=["value", "low", "high"])
    wanted = (marks.panel == panel) & (marks.metric == metric)
    for column, value in place.items():
        wanted &= marks[column] == value
    return marks[wanted]


def cross(axes: Any, paper_rows: "pd.DataFrame", x: Any) -> None:
    """Draw values of the paper that this harness repeats at `x`: a cross, or a bar for a range.

    `axes` are Matplotlib's; `paper_rows` has the ends of each value in `low` and `high`, equal for
    a single value. `x`, the coordinate on the x axis, is one for all rows, or an array with one for
    each.
    """
    low, high = (paper_rows[end].to_numpy(dtype=float) for end in ("low", "high"))
    x, single = np.broadcast_to(x, low.shape), low == high
    if single.any():
        look: dict[str, Any] = {"color": INK, "markersize": 4.5, "zorder": 5, "clip_on": False}
        axes.plot(x[single], low[single], "x", label="the paper", **look)
    if not single.all():
        middle, half = (low + high)[~single] / 2, (high - low)[~single] / 2
        axes.errorbar(
            x[~single], middle, half, fmt="none", ecolor=INK, capsize=2, linewidth=1, zorder=5
        )


def lead_in(rows: "pd.DataFrame") -> str:
    """Return the name of the metric that figures of a summary's rows show.

    `rows` are those of a study's summary. Balanced success, the mean over episodes with a danger (a
    vehicle that the ego would meet) and without, is shown if all sources (`source`, such as runs)
    have it, else plain success.
    """
    return headline_metric(*(set(of.metric) for _, of in rows.groupby("source")))


def interval_of(rows: "pd.DataFrame") -> str:
    """Return which kind of interval a figure draws, by the name in a summary's column `interval`.

    It is `episodes`, over episodes, if these `rows` of a study's summary have it, else
    `seed means`, over seeds of the radio channel's random draws.
    """
    return "episodes" if (rows.interval == "episodes").any() else "seed means"


def curve_colours(
    panels: "Sequence[pd.DataFrame]", given: Mapping[str, str] | None
) -> dict[Curve, str]:
    """Return the colour of each curve, by its source (such as a run) and its condition.

    `panels` are parts of a study's summary, and `given` has colours of conditions; None for the
    usual ones. If there are several sources, each curve has a colour of its own.
    """
    pairs = (zip(panel.source, panel.condition, strict=True) for panel in panels)
    curves = list(dict.fromkeys(chain.from_iterable(pairs)))
    if len({source for source, _ in curves}) > 1:
        return dict(zip(curves, cycle(COLOURS)))
    named = given or conditions(condition for _, condition in curves)
    return {curve: named[curve[1]] for curve in curves}


def plain(axes: Any, lines: str) -> None:
    """Style Matplotlib axes: pale grid lines along `lines` (`x`, `y` or `both`), no frame."""
    axes.grid(axis=lines, color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def key(figure: "Figure", named: Mapping[str, Any], most: int = 4) -> None:
    """Add a legend below a figure, with at most `most` columns, and enlarge the figure for it.

    `named` maps labels to Matplotlib handles.
    """
    if not named:
        return
    for columns in range(min(most, len(named)), 0, -1):
        legend = figure.legend(
            list(named.values()),
            list(named),
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=7,
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
    width, height = figure.get_size_inches()
    tall = legend.get_window_extent().height / figure.dpi
    figure.set_size_inches(width, height + max(tall - ROOM_IN, 0.0))


def lettered(drawn: Any) -> None:
    """Title Matplotlib axes (a), (b) and so on.

    `drawn` is an array or a sequence of them, in reading order.
    """
    for axes, letter in zip(drawn, "abcdefg", strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=8)
