"""`harness fidelity`: the comparison of frozen with closed as tables, a picture and a page."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from harness.core.files import write_whole
from harness.report.drawing.colours import COLOURS, GREY, MARKERS, PALE
from harness.report.drawing.pictures import styled
from harness.report.library import picture
from harness.studies.episode_tables import write_table
from harness.studies.fidelity import WHO, Fidelity, disagreements
from harness.studies.figures import save_all
from harness.studies.html import render

if TYPE_CHECKING:
    import pandas as pd

SHOWN = 20  # ways to disagree that the page lists
VALUES = ("", "_low", "_high")


def write(found: Fidelity, out: Path) -> Path:
    """Write `fidelity` and `episodes` as CSV and JSON Lines, the picture and the page, which is returned."""
    out.mkdir(parents=True, exist_ok=True)
    write_table(found.table, out / "fidelity")
    write_table(found.episodes, out / "episodes")
    save_all(scatter(found.table), out / "fidelity")
    page = render(
        "fidelity.html.j2",
        figure=picture((out / "fidelity.svg").read_bytes()),
        rows=[shown(row) for row in found.table.to_dict("records")],
        headline=" ".join(headline(found)),
        ways=disagreements(found.episodes).head(SHOWN).to_dict("records"),
    )
    write_whole(out / "index.html", page)
    return out / "index.html"


def headline(found: Fidelity) -> list[str]:
    """What came out, in sentences: the rank correlation and the largest difference."""
    rows: list[dict[Any, Any]] = found.table.to_dict("records")
    worst = max(rows, key=lambda row: abs(row["difference"]))
    points, low, high = (100 * worst[f"difference{end}"] for end in VALUES)
    said = [
        f"Largest difference, frozen minus closed: {points:+.1f} points [{low:+.1f}, {high:+.1f}], "
        f"{worst['model']} {worst['prompt']} under {worst['condition']}, n = {worst['n']} episodes."
    ]
    if found.rank == found.rank:
        said.insert(
            0, f"Spearman's rank correlation of {found.ranked} models and conditions: {found.rank:.2f}."
        )
    return said


def shown(row: dict[Any, Any]) -> dict[str, str]:
    """A row of the table as text; percent and points."""

    def cell(name: str, sign: str = "") -> str:
        value, low, high = (100 * row[f"{name}{end}"] for end in VALUES)
        return f"{value:{sign}.1f} [{low:{sign}.1f}, {high:{sign}.1f}]"

    return {
        "who": " · ".join(str(row[name]) for name in WHO), "condition": str(row["condition"]),
        "frozen": cell("frozen"), "closed": cell("closed"), "difference": cell("difference", "+"),
        "agreement": cell("agreement"), "n": str(row["n"]),
    }  # fmt: skip


@styled
def scatter(table: "pd.DataFrame") -> Figure:
    """Closed over frozen success, a point a model and condition, with 95 % intervals over episodes."""
    figure = Figure(figsize=(5.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=0.8, linestyle="--", label="the same")
    rows: list[dict[Any, Any]] = table.to_dict("records")
    who = list(dict.fromkeys(" · ".join(row[name] for name in WHO) for row in rows))
    conditions = list(dict.fromkeys(row["condition"] for row in rows))
    for row in rows:
        n = who.index(" · ".join(row[name] for name in WHO))
        m = conditions.index(row["condition"])
        x, y = (100 * np.array([row[f"{kind}{end}"] for end in VALUES]) for kind in ("frozen", "closed"))
        axes.errorbar(
            x[0], y[0], xerr=[[x[0] - x[1]], [x[2] - x[0]]], yerr=[[y[0] - y[1]], [y[2] - y[0]]],
            color=COLOURS[m % len(COLOURS)], marker=MARKERS[n % len(MARKERS)], markersize=4.5, linewidth=0.7,
        )  # fmt: skip
    for n, one in enumerate(who):
        axes.plot([], [], color=GREY, marker=MARKERS[n % len(MARKERS)], linestyle="none", label=one)
    for m, condition in enumerate(conditions):
        axes.plot([], [], color=COLOURS[m % len(COLOURS)], linewidth=3, label=condition)
    axes.set(xlabel="success on frozen scenes, %", ylabel="success driving, %", xlim=(0, 102), ylim=(0, 102))
    axes.set_aspect("equal")
    axes.grid(color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize=7)
    return figure
