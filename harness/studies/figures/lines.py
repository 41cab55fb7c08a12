"""Lines: success along an axis, and what radios receive along distance or among vehicles."""

from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.arrays import Floats
from harness.core.figures import amount
from harness.radio.reception import by_sight
from harness.report.drawing.colours import COLOURS, FAINT, GREY, INK, MARKERS, conditions
from harness.report.drawing.pictures import styled
from harness.runs.leading import IN_WORDS, SUCCESS
from harness.studies.axes import axis_of
from harness.studies.figures.axes import (
    cross,
    interval_of,
    key,
    lead_in,
    lettered,
    paper_values,
    plain,
)

if TYPE_CHECKING:
    import pandas as pd

    from harness.radio.channel import Physical
    from harness.radio.reception import Compared, Drawn

Curve = tuple[str, str]  # a source and a condition
PAPER_LOSS = ((2, 0.6), (4, 6.6), (8, 18.6))  # vehicles, % lost: the paper's panel of swarm sizes
LEAST_IN = 3.6  # width of a figure
BEST_BAND = (0.65, 0.70)  # of tau, the paper's
# of success
BESIDE = {"size": ("effective_loss", "packet loss"), "tau": ("trigger_rate", "trigger rate")}


@styled
def along(
    panels: "Sequence[pd.DataFrame]",
    paper: "pd.DataFrame | None" = None,
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw success along an axis, a panel for each axis, with loss or trigger rate beside it.

    Panels are parts of a study's summary, and each may have several sources. With the paper's
    values (as in `bars`), its best range of tau is drawn. `colours` gives colours to conditions;
    None for the usual ones. If there are several sources, each curve has a colour of its own.
    """
    width = max(2.5 * len(panels) + 0.2, LEAST_IN)
    figure = Figure(figsize=(width, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    drawn = figure.subplots(1, len(panels), squeeze=False)[0]
    of_curves = _colours(panels, colours)
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


def _colours(panels: "Sequence[pd.DataFrame]", given: Mapping[str, str] | None) -> dict[Curve, str]:
    pairs = (zip(panel.source, panel.condition, strict=True) for panel in panels)
    curves = list(dict.fromkeys(chain.from_iterable(pairs)))
    if len({source for source, _ in curves}) > 1:
        return dict(zip(curves, cycle(COLOURS)))
    named = given or conditions(condition for _, condition in curves)
    return {curve: named[curve[1]] for curve in curves}


def _along(
    axes: Any, panel: "pd.DataFrame", paper: "pd.DataFrame | None", colours: Mapping[Curve, str]
) -> None:
    variable = str(panel.variable.iloc[0])
    lead = lead_in(panel)
    curves = [(axes, lead, IN_WORDS[lead])]
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
        theirs = paper_values(paper, str(panel.panel.iloc[0]), SUCCESS if where is axes else metric)
        cross(where, theirs, theirs.value.to_numpy(dtype=float))
    for where, metric, _ in curves[1:]:
        where.set_ylim(0, 125 if metric == "trigger_rate" else None)
        if metric == "trigger_rate":
            where.set_yticks(range(0, 101, 20))
    if variable == "tau" and paper is not None:
        axes.axvspan(*BEST_BAND, color=FAINT, zorder=0, label="best band of the paper")
    axes.set(xlabel=axis_of(variable).label, ylabel=f"{IN_WORDS[lead]}, %")
    plain(axes, "y")


@styled
def reception(
    name: str, channel: "Physical", messages: "Sequence[Drawn]", against: "Sequence[Compared]"
) -> Figure:
    """Draw a radio's reception over distance, and beside it published curves against the model.

    Args:
        name: the condition's name.
        channel: the radio's channel model.
        messages: simulated reception in line of sight, by distance.
        against: published curves; without any there is no second panel.
    """
    distances_m = np.linspace(1, messages[-1].distance_m, 250)
    curves = by_sight(channel, distances_m)
    figure = Figure(
        figsize=(7.2 if against else 3.8, 3.0), layout=ConstrainedLayoutEngine(w_pad=0.1)
    )
    axes = figure.add_subplot(1, 2 if against else 1, 1)
    for (label, curve), colour, dashes in zip(
        curves.items(), COLOURS, ("-", "--", ":"), strict=False
    ):
        axes.plot(distances_m, 100 * curve, dashes, color=colour, linewidth=1.4, label=label)
    crossing = [each.crossing for each in messages]
    value, low, high = 100 * np.array([(each.value, each.low, each.high) for each in crossing]).T
    axes.errorbar(
        [each.distance_m for each in messages],
        value,
        yerr=[value - low, high - value],
        fmt="o",
        color=INK,
        markersize=2.5,
        capsize=2,
        linewidth=0.8,
        label=f"messages, n = {crossing[0].n} each",
    )
    axes.set(xlabel="distance, m", ylabel="received, %", ylim=(-2, 102), xlim=(0, None))
    axes.set_title(name, fontsize=8)
    axes.legend(fontsize=6, frameon=False)
    if against:
        axes = figure.add_subplot(1, 2, 2)
        axes.axline((0, 0), (100, 100), color=GREY, linewidth=0.8)
        for each in against:
            axes.plot(
                100 * each.curve.reception,
                100 * each.reception,
                ".",
                color=COLOURS[0],
                markersize=2.5,
            )
        mean = 100 * np.mean([each.mean_difference for each in against])
        axes.set(
            xlabel="others' curves, %",
            ylabel="model, %",
            xlim=(-2, 102),
            ylim=(-2, 102),
            aspect="equal",
        )
        axes.set_title(
            f"{amount(len(against), 'curve')}, {mean:.1f} points apart on average", fontsize=8
        )
    return figure


@styled
def crowds(vehicles: Sequence[int], losses: Mapping[str, Floats], title: str) -> Figure:
    """Draw the loss of one transmission over the number of vehicles: radios and the paper's line.

    Args:
        vehicles: numbers of vehicles in radio range, sender and receiver included, (n,).
        losses: losses from 0 to 1 by the name of a radio, and the paper's as `paper`, (n,) each.
        title: the title.
    """
    figure = Figure(figsize=(4.6, 3.2), layout=ConstrainedLayoutEngine(w_pad=0.1))
    axes = figure.add_subplot()
    radios = dict(losses)
    axes.plot(
        vehicles, 100 * radios.pop("paper"), color=INK, linewidth=1.2, label="the paper's line"
    )
    axes.plot(*zip(*PAPER_LOSS, strict=True), "x", color=INK, label="the paper's three points")
    for (name, loss), colour, marker in zip(
        radios.items(), cycle(COLOURS), cycle(MARKERS), strict=False
    ):
        axes.plot(
            vehicles,
            100 * loss,
            marker=marker,
            markersize=3,
            linewidth=1.0,
            color=colour,
            label=name,
        )
    axes.set(
        xscale="log",
        xlabel="vehicles in the radius, the ego included",
        ylabel="packet loss, %",
        ylim=(-2, 102),
    )
    axes.set_xticks(vehicles, [str(n) for n in vehicles])
    axes.minorticks_off()
    axes.set_title(title, fontsize=8)
    axes.legend(fontsize=6, frameon=False)
    return figure
