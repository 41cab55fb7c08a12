"""Points with intervals, on their own or one quantity over another, and fronts:
what one costs in another.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.report.drawing.colours import INK, MARKERS
from harness.report.drawing.pictures import styled
from harness.studies.figures.axes import key, lettered, plain
from harness.studies.figures.described import Rows, Steps


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
                line.x,
                line.y,
                drawstyle="steps-post",
                linewidth=1,
                linestyle=line.line,
                color=line.colour,
                marker=line.marker,
                markersize=line.size,
                label=line.label,
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
