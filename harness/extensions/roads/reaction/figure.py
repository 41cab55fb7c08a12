"""How often others strike the ego, over how often it slows down."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from harness.report.drawing.colours import COLOURS, INK
from harness.report.drawing.pictures import styled
from harness.studies.figures.axes import key, plain

if TYPE_CHECKING:
    import pandas as pd

WIDTH = 0.38  # of a bar
LABELS = {"replay": "others only replay", "react": "others react"}


@styled
def bars(table: "pd.DataFrame") -> Figure:
    """Draw the share of courses in which another strikes the ego, with 95 % intervals.

    `table` has the rows of `Reaction.courses`, one for each number of times that the ego slows
    down.
    """
    figure = Figure(figsize=(4.4, 3.0), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(table))
    for n, (world, label) in enumerate(LABELS.items()):
        rate, low, high = (
            100 * table[f"struck_rate_{world}{end}"] for end in ("", "_low", "_high")
        )
        x = places + (n - 0.5) * WIDTH
        axes.bar(x, rate, WIDTH, color=COLOURS[n], label=label)
        ends = np.abs([low - rate, high - rate])
        axes.errorbar(x, rate, ends, fmt="none", ecolor=INK, linewidth=0.7)
    axes.set(
        xlabel="decisions in which the ego slows down",
        ylabel="courses struck by another, %",
        ylim=(0, None),
    )
    axes.set_xticks(places, table.slower)
    plain(axes, "y")
    handles, labels = axes.get_legend_handles_labels()
    key(figure, dict(zip(labels, handles, strict=True)))
    return figure
