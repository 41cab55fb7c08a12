"""Figures: what radios receive along distance, and lose among vehicles."""

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.arrays import Floats
from harness.core.figures import amount
from harness.extensions.radio.reception import Compared, Drawn, by_sight
from harness.radio.channel import Physical
from harness.report.drawing.colours import COLOURS, GREY, INK, MARKERS
from harness.report.drawing.pictures import styled

PAPER_LOSS = ((2, 0.6), (4, 6.6), (8, 18.6))  # vehicles, % lost: the paper's panel of swarm sizes


@styled
def reception(
    name: str, channel: Physical, messages: Sequence[Drawn], against: Sequence[Compared]
) -> Figure:
    """Draw a radio's reception against distance, and beside it against others' curves, if any.

    Reception is the share of messages received, in line of sight and behind obstacles.

    Args:
        name: name of the radio, the picture's title.
        channel: the radio, whose own curves are drawn.
        messages: how its messages were received in a simulation in line of sight, one item for each
            distance.
        against: published curves, each with the radio's reception at the same distances.
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
    """Draw the loss of one transmission against the number of vehicles in the radius.

    Args:
        vehicles: n numbers of vehicles, sender and receiver included.
        losses: shares of transmissions lost, `(n,)`, by the name of a radio, and the paper's line
            as `paper`.
        title: what the losses are of.
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
