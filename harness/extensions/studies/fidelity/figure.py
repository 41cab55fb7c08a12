"""Closed-loop success over success on frozen scenes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from harness.report.drawing.colours import GREY, MARKERS, conditions
from harness.report.drawing.pictures import styled
from harness.studies.figures.axes import key, plain

if TYPE_CHECKING:
    import pandas as pd


@styled
def scatter(table: "pd.DataFrame", models: Sequence[str]) -> Figure:
    """Draw closed-loop over frozen success, a point a model and condition, with 95 % intervals.

    Closed loop means driven in the simulator, frozen means decided on recorded scenes. A condition
    is a set of settings of radio, asking and fusion, by its name.

    Args:
        table: `Fidelity.table`, a row a point.
        models: names of the models, in the order of the rows.
    """
    figure = Figure(figsize=(4.4, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=0.8, linestyle="--", label="the same")
    markers = {model: MARKERS[n % len(MARKERS)] for n, model in enumerate(dict.fromkeys(models))}
    colours = conditions(table.condition)
    for model, (_, row) in zip(models, table.iterrows(), strict=True):
        x, y = 100 * row["frozen"], 100 * row["closed"]
        x_ends = 100 * np.array([[row["frozen_low"]], [row["frozen_high"]]])
        y_ends = 100 * np.array([[row["closed_low"]], [row["closed_high"]]])
        axes.errorbar(
            x,
            y,
            np.abs(y_ends - y),
            np.abs(x_ends - x),
            color=colours[row["condition"]],
            marker=markers[model],
            markersize=4.5,
            linewidth=0.7,
        )
    for model, marker in markers.items():
        axes.plot([], [], color=GREY, marker=marker, linestyle="none", label=model)
    for condition, colour in colours.items():
        axes.plot([], [], color=colour, linewidth=3, label=condition)
    axes.set(
        xlabel="success on frozen scenes, %",
        ylabel="success in closed loop, %",
        xlim=(0, 102),
        ylim=(0, 102),
    )
    axes.set_aspect("equal")
    plain(axes, "both")
    handles, labels = axes.get_legend_handles_labels()
    key(figure, dict(zip(labels, handles, strict=True)), most=3)
    return figure
