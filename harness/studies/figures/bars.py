"""Bars of operating points, and the paper's values beside them."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from harness.report.drawing.colours import GREY, INK, conditions
from harness.report.drawing.pictures import styled
from harness.runs.headline import IN_WORDS, SUCCESS
from harness.studies.axes import CORE
from harness.studies.figures.axes import (
    CLOUD_MS,
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

SHORT = 13  # characters of a name that fit under a bar


@styled
def operating_points(core: "pd.DataFrame", paper: "pd.DataFrame | None" = None) -> Figure:
    """Draw bars of latency, success and messages of the operating points, with 95 % intervals.

    An operating point is everything a decision depends on besides scene and model. `core` has the
    rows of a study's summary about them, one for each of them and each metric. `paper` has values
    of the paper that this harness repeats, to draw beside them: `low` and `high` by `panel` (the
    paper's figure), `condition`, `value` and `metric`, equal for a single value; None to draw none.
    """
    figure = Figure(figsize=(7.2, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    latency, success, talk = drawn = figure.subplots(1, 3)
    names = list(dict.fromkeys(core.condition))
    headline_metric = lead_in(core)
    talking = [name for name in names if _value(core, name, "messages_per_episode")[0] > 0]
    in_legend = len(names) > 3 or max(map(len, names)) > SHORT
    colours = conditions(names)
    for axes, metric, scale, label, bars, margin in (
        (latency, "latency_proxy_ms", 1.0, "latency of a decision, ms", names, 0.14),
        (success, headline_metric, 100.0, f"{IN_WORDS[headline_metric]}, %", names, 0.14),
        (talk, "messages_per_episode", 1.0, "messages per episode (bars)", talking, 0.25),
    ):
        ticks = ["cloud"] if axes is latency else []
        for x, name in enumerate(bars, len(ticks)):
            mean, down, up = _value(core, name, metric, scale)
            axes.bar(x, mean, width=0.65, color=colours[name], edgecolor=INK, linewidth=0.5)
            axes.errorbar(x, mean, yerr=[[down], [up]], color=INK, capsize=2.5, linewidth=1.0)
            paper_rows = paper_values(
                paper, CORE, SUCCESS if axes is success else metric, condition=name
            )
            cross(axes, paper_rows, x)
            axes.annotate(
                f"{mean:.1f}",
                (x, np.nanmax([mean, mean + up, *paper_rows.high])),
                xytext=(0, 2 if paper_rows.empty else 4),
                textcoords="offset points",
                ha="center",
                fontsize=6,
            )
        if axes is latency:
            axes.bar(
                0, CLOUD_MS, width=0.65, color="white", edgecolor=GREY, hatch="////", linewidth=0.8
            )
            axes.text(0, CLOUD_MS + 8, f"{CLOUD_MS:.0f}", ha="center", va="bottom", fontsize=7)
            axes.text(
                0,
                CLOUD_MS / 2,
                "cited, not runnable",
                ha="center",
                va="center",
                rotation=90,
                fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
            )
        ticks += [name.replace("-", "-\n") for name in bars]
        axes.set_xticks(range(len(ticks)), [] if in_legend else ticks, fontsize=7)
        axes.set_ylabel(label)
        axes.margins(y=margin)
        plain(axes, "y")
    success.set_ylim(0, 108)
    named: dict[str, Any] = {}
    if in_legend:
        named |= {name: Patch(facecolor=colour, edgecolor=INK) for name, colour in colours.items()}
    handles, labels = success.get_legend_handles_labels()
    named |= dict(zip(labels[:1], handles, strict=False))  # the paper's values
    key(figure, named, most=3)
    rate = talk.twinx()
    for n, name in enumerate(talking):
        mean, down, up = _value(core, name, "trigger_rate", 100.0)
        rate.errorbar(
            n + 0.2, mean, yerr=[[down], [up]], marker="D", color=INK, capsize=2, markersize=4
        )
        cross(rate, paper_values(paper, CORE, "trigger_rate", condition=name), n + 0.33)
    rate.set(ylim=(0, 112), ylabel="trigger rate, % (diamonds)")
    rate.spines[["top"]].set_visible(False)
    lettered(drawn)
    return figure


def _value(
    rows: "pd.DataFrame", condition: str, metric: str, scale: float = 1.0
) -> tuple[float, float, float]:
    """Return the mean, and how far the interval reaches below and above it."""
    of = rows[(rows.condition == condition) & (rows.metric == metric)]
    [estimate] = of[of.interval == interval_of(of)][["mean", "ci_low", "ci_high"]].to_numpy(
        dtype=float
    )
    mean, low, high = scale * estimate
    return mean, mean - low, high - mean
