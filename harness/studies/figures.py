"""Panels of a study, for print: conditions side by side, and what changes along an axis."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from harness.report.drawing.colours import COLOURS, GREY, INK, MARKERS, PALE
from harness.report.drawing.pictures import FORMATS, save, styled
from harness.studies.axes import axis_of

if TYPE_CHECKING:
    import pandas as pd

CLOUD_MS = 510.0  # the paper's cloud comparator, which it cites and nobody can run
SHORT = 13  # characters of a name that fit under a bar
BEST_BAND = (0.65, 0.70)  # the paper's


@styled
def composite_a(core: "pd.DataFrame") -> Figure:
    """Latency, success and communication of the operating points, with 95 % intervals over seed means."""
    figure = Figure(figsize=(7.2, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    latency, success, talk = figure.subplots(1, 3)
    names = list(dict.fromkeys(core.condition))
    told_below = len(names) > 3 or max(map(len, names)) > SHORT
    for axes, metric, scale, label in (
        (latency, "latency_proxy_ms", 1.0, "latency of a decision, ms"),
        (success, "success_rate", 100.0, "success, %"),
    ):
        offset = metric == "latency_proxy_ms"
        for n, name in enumerate(names):
            _bar(axes, n + offset, core, name, metric, scale, COLOURS[n % len(COLOURS)])
        if offset:
            axes.bar(0, CLOUD_MS, width=0.65, color="white", edgecolor=GREY, hatch="////", linewidth=0.8)
            axes.text(0, CLOUD_MS + 8, f"{CLOUD_MS:.0f}", ha="center", va="bottom", fontsize=7)
            axes.text(
                0, CLOUD_MS / 2, "cited, not runnable", ha="center", va="center", rotation=90, fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
            )  # fmt: skip
        ticks = (["cloud"] if offset else []) + [name.replace("-", "-\n") for name in names]
        axes.set_xticks(range(len(ticks)), [] if told_below else ticks, fontsize=7)
        axes.set_ylabel(label)
        axes.margins(y=0.14)
    success.set_ylim(0, 108)
    talking = [name for name in names if _value(core, name, "messages_per_episode")[0] > 0]
    for n, name in enumerate(talking):
        _bar(talk, n, core, name, "messages_per_episode", 1.0, COLOURS[names.index(name) % len(COLOURS)])
    talk.set_xticks(range(len(talking)), [] if told_below else talking, fontsize=7)
    if told_below:
        key = [
            Patch(facecolor=COLOURS[n % len(COLOURS)], edgecolor=INK, label=name)
            for n, name in enumerate(names)
        ]
        figure.legend(handles=key, loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    talk.set_ylabel("messages an episode (bars)")
    talk.margins(y=0.25)
    rate = talk.twinx()
    for n, name in enumerate(talking):
        mean, down, up = _value(core, name, "trigger_rate", 100.0)
        rate.errorbar(n + 0.2, mean, yerr=[[down], [up]], marker="D", color=INK, capsize=2, markersize=4)
    rate.set(ylim=(0, 112), ylabel="trigger rate, % (diamonds)")
    for axes in (latency, success, talk):
        _plain(axes)
    rate.spines[["top"]].set_visible(False)
    _lettered((latency, success, talk), "abc")
    return figure


@styled
def along(panels: "Sequence[pd.DataFrame]", best_band: bool = False) -> Figure:
    """Success along one axis a panel, several sources in one, with loss or trigger rate where it changes."""
    figure = Figure(figsize=(2.5 * len(panels) + 0.2, 2.7), layout=ConstrainedLayoutEngine(w_pad=0.1))
    drawn = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(drawn, panels, strict=True):
        _along(axes, panel, best_band)
    _lettered(drawn, "abcdefg")
    named: dict[str, Any] = {}
    for axes in figure.axes:
        named |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        list(named.values()), list(named), loc="outside lower center", ncols=3, frameon=False, fontsize=7
    )
    return figure


def _along(axes: Any, panel: "pd.DataFrame", best_band: bool) -> None:
    variable = str(panel.variable.iloc[0])
    kinds = list(dict.fromkeys(zip(panel.source, panel.condition, strict=True)))
    named = variable == "consensus"
    second, metric, label = None, *{
        "size": ("effective_loss", "loss of one crossing"), "tau": ("trigger_rate", "trigger rate"),
    }.get(variable, ("", ""))  # fmt: skip
    if metric:
        second = axes.twinx()
        second.set_ylabel(f"{label}, %")
        second.spines[["top"]].set_visible(False)
    for n, (source, condition) in enumerate(kinds):
        mine = panel[(panel.source == source) & (panel.condition == condition)]
        name = condition if len(set(panel.source)) == 1 else f"{source}, {condition}"
        x = list(dict.fromkeys(mine.value))
        marker = MARKERS[n % len(MARKERS)]
        for where, what, style in ((axes, "success_rate", "-"), (second, metric, ":")):
            if where is None:
                continue
            at = mine[(mine.metric == what) & (mine.interval == _interval(mine))]
            mean, low, high = (100 * at[k].to_numpy(dtype=float) for k in ("mean", "ci_low", "ci_high"))
            shown = f"success, {name}" if where is axes else f"{label}, {name}"
            colour = COLOURS[n % len(COLOURS)] if where is axes else GREY
            if named:
                where.errorbar(
                    [i + 0.12 * n for i in range(len(x))], mean, yerr=[mean - low, high - mean], capsize=2,
                    linestyle="none", marker=marker, color=colour, markersize=4, label=shown,
                )  # fmt: skip
                continue
            where.plot(x, mean, style, color=colour, marker=marker, markersize=3, linewidth=1.2, label=shown)
            where.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
        if named:
            axes.set_xticks(range(len(x)), x, rotation=30, ha="right", fontsize=7)
    if second is not None:
        second.set_ylim(0, 112 if metric == "trigger_rate" else None)
    if variable == "tau" and best_band:
        axes.axvspan(*BEST_BAND, color="#ECECEC", zorder=0, label="best band of the paper")
    axes.set(xlabel=axis_of(variable).label, ylabel="success, %")
    _plain(axes)


def _interval(rows: "pd.DataFrame") -> str:
    """Over episodes where every seed plays the same ones; over seed means where a seed has its own."""
    return "episodes" if (rows.interval == "episodes").any() else "seed means"


def _value(
    rows: "pd.DataFrame", condition: str, metric: str, scale: float = 1.0
) -> tuple[float, float, float]:
    """Mean, and how far the interval reaches below and above it."""
    of = rows[(rows.condition == condition) & (rows.metric == metric)]
    [one] = of[of.interval == _interval(of)][["mean", "ci_low", "ci_high"]].to_numpy(dtype=float)
    mean, low, high = scale * one
    return mean, mean - low, high - mean


def _bar(
    axes: Any, x: float, rows: "pd.DataFrame", name: str, metric: str, scale: float, colour: str
) -> None:
    mean, down, up = _value(rows, name, metric, scale)
    axes.bar(x, mean, width=0.65, color=colour, edgecolor=INK, linewidth=0.5)
    axes.errorbar(x, mean, yerr=[[down], [up]], color=INK, capsize=2.5, linewidth=1.0)
    axes.annotate(
        f"{mean:.1f}", (x, mean + up), xytext=(0, 2), textcoords="offset points", ha="center", fontsize=6
    )


def _plain(axes: Any) -> None:
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _lettered(drawn: Any, letters: str) -> None:
    for axes, letter in zip(drawn, letters, strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=8)


def save_all(figure: Figure, stem: Path) -> None:
    """Write a figure in every format, each whole or not at all."""
    # Where things go is found once and not for every format: it is half of the work.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for kind in FORMATS:
        save(figure, stem.with_name(f"{stem.name}.{kind}"), kind, dpi=300)
