"""The report's two pictures, as SVG bytes."""

import io
from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from harness.drawing.pictures import BLUE, COLOURS, GREY, INK, MARKERS, ORANGE, PALE, save, styled
from harness.errors import printable
from harness.report.words import LATENCY, SUCCESS
from harness.run.folder import Run, Score

REACTION_MS = (150.0, 250.0)  # the paper's reaction window in an urban intersection
VERDICTS = {"strict": (BLUE, ""), "recovered": (ORANGE, "////"), "failed": ("white", "xxxx")}


@styled
def success_latency(run: Run) -> bytes | None:
    """Success rate over latency, a point a condition; None if no condition has both."""
    points = [(c, run.score(c, LATENCY), run.score(c, SUCCESS)) for c in run.conditions]
    figure = Figure(figsize=(6.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    drawn = 0
    for n, (condition, latency, success) in enumerate(points):
        if latency is None or success is None:
            continue
        drawn += 1
        (x, left, right), (y, down, up) = _bar(latency, 1.0), _bar(success, 100.0)
        axes.errorbar(
            x, y, xerr=[[left], [right]], yerr=[[down], [up]], linestyle="none", capsize=3, elinewidth=1.1,
            marker=MARKERS[n % len(MARKERS)], color=COLOURS[n % len(COLOURS)], markersize=7,
            markeredgecolor=INK, markeredgewidth=0.6, label=printable(condition, 40),
        )  # fmt: skip
    if not drawn:
        return None
    axes.axvspan(*REACTION_MS, color="#ECECEC", zorder=0, label="reaction window, 150 to 250 ms")
    axes.set(xlabel="latency of a decision, ms", ylabel="success rate, %")
    axes.margins(0.12)
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, -4.0), min(high, 104.0))
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False)
    return _svg(figure)


def _bar(score: Score, factor: float) -> tuple[float, float, float]:
    """Value and how far the interval reaches below and above it."""
    value = (score.value or 0.0) * factor
    if score.low is None or score.high is None:
        return value, 0.0, 0.0
    return value, max(value - score.low * factor, 0.0), max(score.high * factor - value, 0.0)


@styled
def verdicts(counts: Mapping[str, Mapping[str, int]]) -> bytes:
    """Stacked bars of strict, recovered and failed answers, by role and verdict."""
    figure = Figure(figsize=(6.6, 0.9 + 0.42 * len(counts)), layout="constrained")
    axes = figure.add_subplot()
    for y, of in enumerate(counts.values()):
        total, start = sum(of.values()), 0.0
        for verdict, (colour, hatch) in VERDICTS.items():
            share = 100.0 * of.get(verdict, 0) / total
            axes.barh(
                y, share, left=start, color=colour, hatch=hatch, edgecolor=INK, linewidth=0.6, height=0.62
            )
            start += share
        axes.text(101.0, y, f"n = {total}", va="center", size=8, color=GREY)
    handles = [Patch(facecolor=c, hatch=h, edgecolor=INK, label=v) for v, (c, h) in VERDICTS.items()]
    figure.legend(handles=handles, loc="outside upper left", ncols=3, frameon=False)
    axes.set_yticks(range(len(counts)), labels=[printable(role, 30) for role in counts])
    axes.set(xlim=(0, 100), xlabel="answers, %")
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)


def _svg(figure: Figure) -> bytes:
    data = io.BytesIO()
    save(figure, data, "svg")
    return data.getvalue()
