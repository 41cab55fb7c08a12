"""Points with intervals, on their own or one quantity over another, and fronts:
what one costs in another.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.statistics import Estimate
from harness.report.drawing.colours import INK, MARKERS
from harness.report.drawing.pictures import styled
from harness.studies.figures.axes import key, lettered, plain


@dataclass(frozen=True)
class Steps:
    """Describe a step curve of a figure, whose points ascend in x and y.

    `x` is where each step begins, in the axis's unit, and `y` its height. `label` is the curve's
    name in the legend, `look` has Matplotlib's arguments for how the line is drawn, and `name` is
    written beside its last point.
    """

    label: str  # the curve's name in the legend; empty for none
    x: Sequence[float]  # where each step begins, ascending, in the axis's unit
    y: Sequence[float]  # the height of each step, ascending
    # how it is drawn: keyword arguments of Matplotlib's `Axes.plot`
    look: Mapping[str, Any] = field(default_factory=dict)
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


@styled
def intervals(panels: Sequence[Rows], colours: Mapping[str, str]) -> Figure:
    """Draw estimates with their 95 % intervals, a panel for each of `panels`, one below the other.

    A series of estimates has a colour, by its name in `colours`, and a marker. Where an interval is
    unknown, the point stands alone.
    """
    heights = [len(panel.names) * (0.1 + 0.1 * len(panel.series)) + 0.5 for panel in panels]
    # One below the other, as a telephone can show them.
    figure = Figure(figsize=(3.9, sum(heights) + 0.3), layout="constrained")
    drawn = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, panel in zip(drawn, panels, strict=True):
        for n, (name, estimates) in enumerate(panel.series.items()):
            shift = 0.7 * ((n + 0.5) / len(panel.series) - 0.5)
            pairs = [
                (y + shift, each)
                for y, each in enumerate(estimates)
                if each and not np.isnan(each.value)
            ]
            ends = np.array([(each.value, each.low, each.high) for _, each in pairs]).reshape(-1, 3)
            value, low, high = panel.scale * ends.T
            axes.errorbar(
                value,
                [y for y, _ in pairs],
                xerr=np.nan_to_num([value - low, high - value]),
                fmt=MARKERS[n % len(MARKERS)],
                color=colours[name],
                label=name,
                markersize=4,
                capsize=2,
                linewidth=1,
                clip_on=False,
            )
        axes.set_yticks(range(len(panel.names)), panel.names)
        axes.set(xlabel=panel.quantity, ylim=(len(panel.names) - 0.5, -0.5))
        # the whole range, so that small differences look small
        axes.axvspan(0, panel.scale, color="none")
        axes.tick_params(axis="y", length=0)
        plain(axes, "x")
    lettered(drawn)
    handles, labels = drawn[0].get_legend_handles_labels()
    key(figure, dict(zip(labels, handles, strict=True)))
    return figure


@styled
def fronts(panels: Sequence[tuple[str, str, Sequence[Steps]]], success: str) -> Figure:
    """Draw success in percent against a cost, as step curves, side by side.

    Each of `panels` is its title, the label of the cost with its unit, and its curves, whose x is
    the cost and y success in percent; `success` is the metric's name for people.
    """
    width = max(3.6 * len(panels), 4.4)
    figure = Figure(figsize=(width, 3.6), layout=ConstrainedLayoutEngine(w_pad=0.1))
    for axes, (title, cost, lines) in zip(
        figure.subplots(1, len(panels), squeeze=False, sharey=True)[0], panels, strict=True
    ):
        for line in lines:
            axes.plot(
                line.x, line.y, drawstyle="steps-post", linewidth=1, label=line.label, **line.look
            )
        axes.set(xlabel=cost, ylabel=f"{success}, %" if axes is figure.axes[0] else "")
        axes.set_title(title, fontsize=8)
        axes.margins(x=0.1, y=0.1)
        plain(axes, "both")
        for line in lines:  # a name extends to the middle, away from the ends of the axis
            right = line.x[-1] > sum(axes.get_xlim()) / 2
            axes.annotate(
                line.name,
                (line.x[-1], line.y[-1]),
                xytext=(5 if right else -5, 5),
                textcoords="offset points",
                ha="right" if right else "left",
                fontsize=6.5,
                color=INK,
            )
    handles, labels = figure.axes[0].get_legend_handles_labels()
    key(figure, dict(zip(labels, handles, strict=True)))
    return figure
