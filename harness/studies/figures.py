"""Pictures of a study, for print: conditions compared, changes along an axis, frozen against closed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from harness.core.arrays import Floats
from harness.report.drawing.colours import COLOURS, GREY, INK, MARKERS, PALE, conditions
from harness.report.drawing.pictures import styled
from harness.studies.axes import CORE, axis_of

if TYPE_CHECKING:
    import pandas as pd

    from harness.studies.reception import Compared, Drawn

CLOUD_MS = 510.0  # the paper's cloud comparator, which it cites and nobody can run
PAPER_LOSS = ((2, 0.6), (4, 6.6), (8, 18.6))  # vehicles, % lost: its panel of swarm sizes
SHORT = 13  # characters of a name that fit under a bar
BEST_BAND = (0.65, 0.70)  # the paper's
# What is drawn beside success along an axis.
BESIDE = {"size": ("effective_loss", "packet loss"), "tau": ("trigger_rate", "trigger rate")}


@styled
def composite_a(core: "pd.DataFrame", paper: "pd.DataFrame | None" = None) -> Figure:
    """Latency, success and communication of the operating points, with 95 % intervals over seed means.

    Args:
        core: a study's summary of them.
        paper: the paper's values beside (`harness.studies.ledger.marks`).
    """
    figure = Figure(figsize=(7.2, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    latency, success, talk = drawn = figure.subplots(1, 3)
    names = list(dict.fromkeys(core.condition))
    talking = [name for name in names if _value(core, name, "messages_per_episode")[0] > 0]
    in_legend = len(names) > 3 or max(map(len, names)) > SHORT
    colours = conditions(names)
    for axes, metric, scale, label, bars, margin in (
        (latency, "latency_proxy_ms", 1.0, "latency of a decision, ms", names, 0.14),
        (success, "success_rate", 100.0, "success, %", names, 0.14),
        (talk, "messages_per_episode", 1.0, "messages per episode (bars)", talking, 0.25),
    ):
        ticks = ["cloud"] if axes is latency else []
        for x, name in enumerate(bars, len(ticks)):
            mean, down, up = _value(core, name, metric, scale)
            axes.bar(x, mean, width=0.65, color=colours[name], edgecolor=INK, linewidth=0.5)
            axes.errorbar(x, mean, yerr=[[down], [up]], color=INK, capsize=2.5, linewidth=1.0)
            theirs = _paper(paper, CORE, metric, condition=name)
            _cross(axes, theirs, x)
            axes.annotate(
                f"{mean:.1f}", (x, np.nanmax([mean, mean + up, *theirs.high])),
                xytext=(0, 2 if theirs.empty else 4), textcoords="offset points", ha="center", fontsize=6,
            )  # fmt: skip
        if axes is latency:
            axes.bar(0, CLOUD_MS, width=0.65, color="white", edgecolor=GREY, hatch="////", linewidth=0.8)
            axes.text(0, CLOUD_MS + 8, f"{CLOUD_MS:.0f}", ha="center", va="bottom", fontsize=7)
            axes.text(
                0, CLOUD_MS / 2, "cited, not runnable", ha="center", va="center", rotation=90, fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
            )  # fmt: skip
        ticks += [name.replace("-", "-\n") for name in bars]
        axes.set_xticks(range(len(ticks)), [] if in_legend else ticks, fontsize=7)
        axes.set_ylabel(label)
        axes.margins(y=margin)
        _plain(axes, "y")
    success.set_ylim(0, 108)
    key: list[Any] = []
    if in_legend:
        key += [Patch(facecolor=colour, edgecolor=INK, label=name) for name, colour in colours.items()]
    key += success.get_legend_handles_labels()[0][:1]  # the paper's values
    if key:
        figure.legend(handles=key, loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    rate = talk.twinx()
    for n, name in enumerate(talking):
        mean, down, up = _value(core, name, "trigger_rate", 100.0)
        rate.errorbar(n + 0.2, mean, yerr=[[down], [up]], marker="D", color=INK, capsize=2, markersize=4)
        _cross(rate, _paper(paper, CORE, "trigger_rate", condition=name), n + 0.33)
    rate.set(ylim=(0, 112), ylabel="trigger rate, % (diamonds)")
    rate.spines[["top"]].set_visible(False)
    _lettered(drawn)
    return figure


@styled
def along(panels: "Sequence[pd.DataFrame]", paper: "pd.DataFrame | None" = None) -> Figure:
    """Success along one axis a panel, several sources in one, with loss or trigger rate where it changes.

    Args:
        panels: of a study's summary.
        paper: the paper's values beside (`harness.studies.ledger.marks`), and the band that it calls best.
    """
    figure = Figure(figsize=(2.5 * len(panels) + 0.2, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    drawn = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(drawn, panels, strict=True):
        _along(axes, panel, paper)
    _lettered(drawn)
    key: dict[str, Any] = {}
    for axes in figure.axes:
        key |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        list(key.values()), list(key), loc="outside lower center", ncols=3, frameon=False, fontsize=7
    )
    return figure


def _along(axes: Any, panel: "pd.DataFrame", paper: "pd.DataFrame | None") -> None:
    variable = str(panel.variable.iloc[0])
    curves = [(axes, "success_rate", "success")]
    if variable in BESIDE:
        metric, label = BESIDE[variable]
        beside = axes.twinx()
        beside.set_ylabel(f"{label}, %")
        beside.spines[["top"]].set_visible(False)
        curves.append((beside, metric, label))
    ticks = list(dict.fromkeys(panel.value)) if variable == "consensus" else []
    for n, (source, condition) in enumerate(dict.fromkeys(zip(panel.source, panel.condition, strict=True))):
        rows = panel[(panel.source == source) & (panel.condition == condition)]
        name = condition if len(set(panel.source)) == 1 else f"{source}, {condition}"
        for where, metric, label in curves:
            at = rows[(rows.metric == metric) & (rows.interval == _interval(rows))]
            mean, low, high = (100 * at[k].to_numpy(dtype=float) for k in ("mean", "ci_low", "ci_high"))
            look: dict[str, Any] = {
                "color": COLOURS[n % len(COLOURS)] if where is axes else GREY,
                "marker": MARKERS[n % len(MARKERS)], "label": f"{label}, {name}",
            }  # fmt: skip
            if ticks:
                x = [ticks.index(value) + 0.12 * n for value in at.value]
                spread = [mean - low, high - mean]
                where.errorbar(x, mean, yerr=spread, capsize=2, linestyle="none", markersize=4, **look)
                continue
            x = at.value.tolist()
            where.plot(x, mean, "-" if where is axes else ":", markersize=3, linewidth=1.2, **look)
            where.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0)
    if ticks:
        axes.set_xticks(range(len(ticks)), ticks, rotation=30, ha="right", fontsize=7)
    for where, metric, _ in curves:
        theirs = _paper(paper, str(panel.panel.iloc[0]), metric)
        _cross(where, theirs, theirs.value.to_numpy(dtype=float))
    for where, metric, _ in curves[1:]:
        where.set_ylim(0, 125 if metric == "trigger_rate" else None)
        if metric == "trigger_rate":
            where.set_yticks(range(0, 101, 20))
    if variable == "tau" and paper is not None:
        axes.axvspan(*BEST_BAND, color="#ECECEC", zorder=0, label="best band of the paper")
    axes.set(xlabel=axis_of(variable).label, ylabel="success, %")
    _plain(axes, "y")


@styled
def scatter(table: "pd.DataFrame", models: Sequence[str]) -> Figure:
    """Closed over frozen success, a point a model and condition, with 95 % intervals over episodes.

    Args:
        table: of `harness.studies.fidelity`.
        models: who drove, of each row.
    """
    figure = Figure(figsize=(5.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=0.8, linestyle="--", label="the same")
    markers = {model: MARKERS[n % len(MARKERS)] for n, model in enumerate(dict.fromkeys(models))}
    colours = conditions(table.condition)
    for model, (_, row) in zip(models, table.iterrows(), strict=True):
        x, y = (
            100 * np.array([row[f"{kind}{end}"] for end in ("", "_low", "_high")])
            for kind in ("frozen", "closed")
        )
        axes.errorbar(
            x[0], y[0], xerr=[[x[0] - x[1]], [x[2] - x[0]]], yerr=[[y[0] - y[1]], [y[2] - y[0]]],
            color=colours[row["condition"]], marker=markers[model], markersize=4.5, linewidth=0.7,
        )  # fmt: skip
    for model, marker in markers.items():
        axes.plot([], [], color=GREY, marker=marker, linestyle="none", label=model)
    for condition, colour in colours.items():
        axes.plot([], [], color=colour, linewidth=3, label=condition)
    axes.set(
        xlabel="success on frozen scenes, %", ylabel="success in closed loop, %", xlim=(0, 102), ylim=(0, 102)
    )
    axes.set_aspect("equal")
    _plain(axes, "both")
    figure.legend(loc="outside right upper", frameon=False, fontsize=7)
    return figure


def _paper(marks: "pd.DataFrame | None", panel: str, metric: str, **place: str) -> "pd.DataFrame":
    """What the paper says of a metric in a panel; nothing if its values are not to be drawn."""
    import pandas as pd

    if marks is None:
        return pd.DataFrame(columns=["value", "low", "high"])
    wanted = (marks.panel == panel) & (marks.metric == metric)
    for column, value in place.items():
        wanted &= marks[column] == value
    return marks[wanted]


def _cross(axes: Any, theirs: "pd.DataFrame", x: Any) -> None:
    """Draw the paper's values at `x`: a cross, or the range that it gives."""
    low, high = (theirs[end].to_numpy(dtype=float) for end in ("low", "high"))
    x, single = np.broadcast_to(x, low.shape), low == high
    if single.any():
        look: dict[str, Any] = {"color": INK, "markersize": 4.5, "zorder": 5, "clip_on": False}
        axes.plot(x[single], low[single], "x", label="the paper", **look)
    if not single.all():
        middle, half = (low + high)[~single] / 2, (high - low)[~single] / 2
        axes.errorbar(x[~single], middle, half, fmt="none", ecolor=INK, capsize=2, linewidth=1, zorder=5)


def _interval(rows: "pd.DataFrame") -> str:
    """Over episodes where every seed plays the same ones; over seed means where a seed has its own."""
    return "episodes" if (rows.interval == "episodes").any() else "seed means"


def _value(
    rows: "pd.DataFrame", condition: str, metric: str, scale: float = 1.0
) -> tuple[float, float, float]:
    """Mean, and how far the interval reaches below and above it."""
    of = rows[(rows.condition == condition) & (rows.metric == metric)]
    [estimate] = of[of.interval == _interval(of)][["mean", "ci_low", "ci_high"]].to_numpy(dtype=float)
    mean, low, high = scale * estimate
    return mean, mean - low, high - mean


def _plain(axes: Any, lines: str) -> None:
    axes.grid(axis=lines, color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _lettered(drawn: Any) -> None:
    for axes, letter in zip(drawn, "abcdefg", strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=8)


@styled
def reception(
    name: str, curves: Mapping[str, Floats], distances_m: Floats, messages: "Sequence[Drawn]",
    against: "Sequence[Compared]",
) -> Figure:  # fmt: skip
    """A radio's reception against distance, and beside it, if there are any, against others' curves.

    Args:
        name: of the condition.
        curves: label of what stands between, and reception at `distances_m`.
        distances_m: `(n,)`.
        messages: what was drawn in sight.
        against: others' curves.
    """
    figure = Figure(figsize=(7.2 if against else 3.8, 3.0), layout=ConstrainedLayoutEngine(w_pad=0.1))
    axes = figure.add_subplot(1, 2 if against else 1, 1)
    for (label, curve), colour, dashes in zip(curves.items(), COLOURS, ("-", "--", ":"), strict=False):
        axes.plot(distances_m, 100 * curve, dashes, color=colour, linewidth=1.4, label=label)
    crossing = [each.crossing for each in messages]
    value, low, high = 100 * np.array([(each.value, each.low, each.high) for each in crossing]).T
    axes.errorbar(
        [each.distance_m for each in messages], value, yerr=[value - low, high - value], fmt="o", color=INK,
        markersize=2.5, capsize=2, linewidth=0.8, label=f"messages, n = {crossing[0].n} each",
    )  # fmt: skip
    axes.set(xlabel="distance, m", ylabel="received, %", ylim=(-2, 102), xlim=(0, None))
    axes.set_title(name, fontsize=8)
    axes.legend(fontsize=6, frameon=False)
    if against:
        axes = figure.add_subplot(1, 2, 2)
        axes.axline((0, 0), (100, 100), color=GREY, linewidth=0.8)
        for each in against:
            axes.plot(100 * each.curve.reception, 100 * each.reception, ".", color=COLOURS[0], markersize=2.5)
        mean = 100 * np.mean([each.mean_difference for each in against])
        axes.set(
            xlabel="others' curves, %", ylabel="model, %", xlim=(-2, 102), ylim=(-2, 102), aspect="equal"
        )
        curves_ = f"{len(against)} curve{'s' * (len(against) != 1)}"
        axes.set_title(f"{curves_}, {mean:.1f} points apart on average", fontsize=8)
    return figure


@styled
def crowds(vehicles: Sequence[int], losses: Mapping[str, Floats], line: Floats, title: str) -> Figure:
    """Loss of one transmission against vehicles in the radius: radios beside the paper's line.

    Args:
        vehicles: `(n,)`, sender and receiver included.
        losses: name of a radio to its losses, `(n,)`.
        line: the paper's, `(n,)`.
        title: what the losses are of.
    """
    figure = Figure(figsize=(4.6, 3.2), layout=ConstrainedLayoutEngine(w_pad=0.1))
    axes = figure.add_subplot()
    axes.plot(vehicles, 100 * line, color=INK, linewidth=1.2, label="the paper's line")
    axes.plot(*zip(*PAPER_LOSS, strict=True), "x", color=INK, label="the paper's three points")
    for (name, loss), colour, marker in zip(losses.items(), COLOURS, MARKERS, strict=False):
        axes.plot(vehicles, 100 * loss, marker=marker, markersize=3, linewidth=1.0, color=colour, label=name)
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
