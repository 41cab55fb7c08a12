"""Lines: success along an axis."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.report.drawing.colours import FAINT, GREY, MARKERS
from harness.report.drawing.pictures import styled
from harness.runs.headline import IN_WORDS, SUCCESS
from harness.studies.axes import axis_of
from harness.studies.figures.axes import (
    BESIDE,
    BEST_BAND,
    Curve,
    cross,
    curve_colours,
    interval_of,
    key,
    lead_in,
    lettered,
    paper_values,
    plain,
)

if TYPE_CHECKING:
    import pandas as pd

LEAST_IN = 3.6  # width of a figure


@styled
def along(
    panels: "Sequence[pd.DataFrame]",
    paper: "pd.DataFrame | None" = None,
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw success along an axis, a panel for each axis, with loss or trigger rate beside it.

    An axis is what a sweep varies, such as packet loss; the trigger rate is the share of decisions
    in which the ego asks helpers. Panels are parts of a study's summary, and each may have several
    sources (runs). `paper` is the table of the paper's values, None to draw none; with it, its best
    range of tau, the entropy threshold, is drawn. `colours` gives colours to conditions (operating
    points); None for the usual ones. If there are several sources, each curve has a colour of its
    own.
    """
    width = max(2.5 * len(panels) + 0.2, LEAST_IN)
    figure = Figure(figsize=(width, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    drawn = figure.subplots(1, len(panels), squeeze=False)[0]
    of_curves = curve_colours(panels, colours)
    for axes, panel in zip(drawn, panels, strict=True):
        _along(axes, panel, paper, of_curves)
    lettered(drawn)
    named: dict[str, Any] = {}
    for axes in figure.axes:
        named |= {
            label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
    key(figure, named, most=3)
    return figure


def _along(
    axes: Any, panel: "pd.DataFrame", paper: "pd.DataFrame | None", colours: Mapping[Curve, str]
) -> None:
    variable = str(panel.variable.iloc[0])
    headline_metric = lead_in(panel)
    curves = [(axes, headline_metric, IN_WORDS[headline_metric])]
    if variable in BESIDE:
        metric, label = BESIDE[variable]
        beside = axes.twinx()
        beside.set_ylabel(f"{label}, %")
        beside.spines[["top"]].set_visible(False)
        curves.append((beside, metric, label))
    ticks = list(dict.fromkeys(panel.value)) if axis_of(variable).worded else []
    for n, (source, condition) in enumerate(
        dict.fromkeys(zip(panel.source, panel.condition, strict=True))
    ):
        rows = panel[(panel.source == source) & (panel.condition == condition)]
        name = condition if len(set(panel.source)) == 1 else f"{source}, {condition}"
        for where, metric, label in curves:
            at = rows[(rows.metric == metric) & (rows.interval == interval_of(rows))]
            mean, low, high = (
                100 * at[k].to_numpy(dtype=float) for k in ("mean", "ci_low", "ci_high")
            )
            look: dict[str, Any] = {
                "color": colours[source, condition] if where is axes else GREY,
                "marker": MARKERS[n % len(MARKERS)],
                "label": f"{label}, {name}",
            }
            if ticks:
                x = [ticks.index(value) + 0.12 * n for value in at.value]
                spread = [mean - low, high - mean]
                where.errorbar(
                    x, mean, yerr=spread, capsize=2, linestyle="none", markersize=4, **look
                )
                continue
            x = at.value.tolist()
            where.plot(x, mean, "-" if where is axes else ":", markersize=3, linewidth=1.2, **look)
            where.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0)
    if ticks:
        axes.set_xticks(range(len(ticks)), ticks, rotation=30, ha="right", fontsize=7)
    for where, metric, _ in curves:
        paper_rows = paper_values(
            paper, str(panel.panel.iloc[0]), SUCCESS if where is axes else metric
        )
        cross(where, paper_rows, paper_rows.value.to_numpy(dtype=float))
    for where, metric, _ in curves[1:]:
        where.set_ylim(0, 125 if metric == "trigger_rate" else None)
        if metric == "trigger_rate":
            where.set_yticks(range(0, 101, 20))
    if variable == "tau" and paper is not None:
        axes.axvspan(*BEST_BAND, color=FAINT, zorder=0, label="best band of the paper")
    axes.set(xlabel=axis_of(variable).label, ylabel=f"{IN_WORDS[headline_metric]}, %")
    plain(axes, "y")
