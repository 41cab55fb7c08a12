"""A heat map: a number for every pair of a row and a column."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.arrays import Floats
from harness.report.drawing.colours import ON_DATA, SHADES, WHITE
from harness.report.drawing.pictures import styled

MOST_BESIDE = 3  # columns of panels that stand beside each other
COLUMN_IN, CHARACTER_IN = 0.72, 0.065  # widths


@styled
def heat_map(
    panels: Mapping[str, Floats],
    rows: Sequence[str],
    columns: Sequence[str],
    row: str = "",
    column: str = "",
) -> Figure:
    """Draw heat maps of percentages, one panel for each array of `panels`, by its title.

    An array is (R, C), of R rows and C columns, with values from 0 to 100. `rows` and `columns` are
    the names along both axes, `row` and `column` the titles of the axes.
    """
    room = COLUMN_IN * len(columns) / CHARACTER_IN
    beside = len(columns) <= MOST_BESIDE and max(map(len, panels)) <= room
    shape = (1, len(panels)) if beside else (len(panels), 1)
    size = (
        1.3 + 0.08 * max(map(len, rows)) + COLUMN_IN * len(columns) * shape[1],
        0.7 + 0.08 * max(map(len, columns)) + (0.35 + 0.24 * len(rows)) * shape[0],
    )
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))
    shades = LinearSegmentedColormap.from_list("shades", SHADES)
    low, high = (float(end(list(map(end, panels.values())))) for end in (np.nanmin, np.nanmax))
    for axes, (title, percent) in zip(
        figure.subplots(*shape, squeeze=False).flat, panels.items(), strict=True
    ):
        edges = beside or axes is figure.axes[-1], not beside or axes is figure.axes[0]
        axes.imshow(
            percent, cmap=shades, vmin=low - 0.1 * (high - low) - 1, vmax=high + 1, aspect="auto"
        )
        axes.set_title(title, fontsize=8)
        axes.set_xticks(
            range(len(columns)), columns if edges[0] else [], rotation=40, ha="right", fontsize=7
        )
        axes.set_yticks(range(len(rows)), rows if edges[1] else [], fontsize=7)
        axes.set(xlabel=column if edges[0] else "", ylabel=row if edges[1] else "")
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        for (i, j), value in np.ndenumerate(percent):
            light = high > low and value > low + 0.8 * (high - low)
            ink = WHITE if light else ON_DATA
            axes.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=7, color=ink)
    return figure
