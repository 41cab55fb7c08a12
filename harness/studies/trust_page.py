"""What the folder of `harness study trust` has: a heat map, tables and a page."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.figures import as_mapping, shown
from harness.core.files import bytes_of, write_whole
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.report.drawing.colours import INK
from harness.report.drawing.pictures import styled
from harness.report.library import picture
from harness.report.page import environment
from harness.runs.metrics import SUCCESS, over_episodes
from harness.studies.folder import write, write_manifest
from harness.studies.trust import BASE, EXCLUDED, PEACE, Bench, Cell

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = Path(__file__).parent / "templates"
LOSES, COSTS = 2.0, 1.0  # points: what a robust rule may lose under an attack, and cost in peace


def in_a_sentence(bench: Bench) -> list[str]:
    """What asking is worth in peace, what the worst attack takes from the linear pool, and who stands it."""
    share, peace = bench.shares[0], bench.success(BASE)
    alone, worst = over_episodes(SUCCESS, bench.alone), bench.worst(BASE, share)
    said = [
        f"While nobody attacks, {shown(peace)} % of episodes succeed under the linear pool, and "
        f"{shown(alone)} % with an ego that never asks.",
        f"If {100 * share:.0f} % of the helpers attack, {worst} harms the linear pool most: "
        f"{shown(bench.success(BASE, worst, share))} % succeed.",
    ]
    best = max(bench.rules, key=lambda rule: bench.mean(rule, share).value)
    said.append(
        f"On average over all {len(bench.attacks)} attacks, {best} succeeds most often, in "
        f"{shown(bench.mean(best, share))} % (linear: {shown(bench.mean(BASE, share))}); its price in "
        f"peace, in points: {price(bench, best)}."
    )
    if "liar+spoof" in bench.attacks:
        stand = [
            rule for rule in bench.rules
            if 100 * bench.price(rule).value >= -COSTS
            and 100 * bench.loss(rule, "liar+spoof", share).value >= -LOSES
        ]  # fmt: skip
        said.append(
            f"Rules that lose {LOSES:g} points or less to a liar at a spoofed place, and cost {COSTS:g} "
            f"point or less in peace: {', '.join(stand) or 'none'}."
        )
    return said


def price(bench: Bench, rule: str) -> str:
    """What a rule costs in peace; a dash for the one that others are held against."""
    return "–" if rule == BASE else shown(bench.price(rule))


@styled
def heat_map(bench: Bench) -> Figure:
    """Success of every rule under every attack, a panel a share; peace is the first row."""
    rows = ["nobody attacks", *bench.attacks]
    size = (1.7 + 0.62 * len(bench.rules), 0.9 + (0.3 + 0.22 * len(rows)) * len(bench.shares))
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=0.06))
    panels = figure.subplots(len(bench.shares), 1, squeeze=False)[:, 0]
    for axes, share in zip(panels, bench.shares, strict=True):
        of = np.array([
            [100 * bench.success(rule).value for rule in bench.rules],
            *([100 * bench.success(r, attack, share).value for r in bench.rules] for attack in bench.attacks),
        ])  # fmt: skip
        axes.imshow(of, cmap="Blues", vmin=-25, vmax=100, aspect="auto")
        axes.set_title(f"{100 * share:.0f} % of the helpers attack", fontsize=8)
        names = bench.rules if axes is panels[-1] else [""] * len(bench.rules)
        axes.set_xticks(range(len(bench.rules)), names, rotation=40, ha="right", fontsize=7)
        axes.set_yticks(range(len(rows)), rows, fontsize=7)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.axhline(0.5, color="white", linewidth=3)
        for (i, j), rate in np.ndenumerate(of):
            axes.text(
                j,
                i,
                f"{rate:.0f}",
                ha="center",
                va="center",
                fontsize=6.5,
                color="white" if rate > 65 else INK,
            )
    return figure


def tables(bench: Bench) -> "dict[str, pd.DataFrame]":
    """`cells` as a data frame: a row a cell and metric."""
    import pandas as pd

    return {"figures": pd.DataFrame([row for cell in bench.cells.values() for row in _rows(bench, cell)])}


def _rows(bench: Bench, cell: Cell) -> list[dict[str, Any]]:
    of = {"rule": cell.rule, "attack": cell.attack or "none", "share": cell.share}
    estimates = {
        "success_rate": over_episodes(SUCCESS, cell.success),
        "unsafe_rate": over_episodes("unsafe_rate", cell.unsafe),
        "nats": over_episodes("nats", cell.nats),
        **{f"detection_{name}": e for name, e in (cell.detection() or {}).items()},
    }
    if cell.attack == PEACE:
        estimates["price_in_peace"] = bench.price(cell.rule)
    elif cell.attack != EXCLUDED:
        estimates["loss_to_attack"] = bench.loss(cell.rule, cell.attack, cell.share)
    p = bench.holm.get((cell.rule, cell.attack, cell.share))
    rows = [
        {**of, "metric": name, "value": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n,
         "p_holm_against_linear": p if name == "success_rate" else None}
        for name, e in estimates.items()
    ]  # fmt: skip
    found = {"value": cell.time_to_detection, "n": sum(1 for n in cell.first if n)}
    return [*rows, {**of, "metric": "messages_to_detection", **found}] if cell.flagged is not None else rows


def as_json(bench: Bench) -> dict[str, Any]:
    """The figures of every cell, for machines."""
    cells = [
        {"rule": c.rule, "attack": c.attack or None, "share": c.share,
         "success": as_mapping(over_episodes(SUCCESS, c.success)),
         "detection": {k: as_mapping(e) for k, e in found.items()} if (found := c.detection()) else None}
        for c in bench.cells.values()
    ]  # fmt: skip
    return {"run": bench.name, "dataset": bench.source, "condition": bench.condition, "cells": cells}


def detections(bench: Bench) -> dict[str, list[tuple[str, float, Mapping[str, Estimate], Cell]]]:
    """How rules that judge helpers find attackers, and whom they take for one in peace, by rule."""
    found: dict[str, list[tuple[str, float, Mapping[str, Estimate], Cell]]] = {}
    for (rule, attack, share), cell in bench.cells.items():
        if figures := cell.detection():
            found.setdefault(rule, []).append((attack or "nobody attacks", share, figures, cell))
    return found


def write_bench(bench: Bench, out: Path) -> Path:
    """Write pictures, tables and the page, `trust.json` last; returns the page's path."""
    drawn = {"heat-map": heat_map(bench)}
    write(out, drawn, tables(bench))
    page = out / "index.html"
    rendered = environment(TEMPLATES).get_template("trust.html.j2").render(
        bench=bench, sentences=in_a_sentence(bench), shown=shown, price=price, excluded=EXCLUDED, base=BASE,
        pictures={name: picture(bytes_of(out / f"{name}.svg", "picture")) for name in drawn},
        detections=detections(bench), n=bench.price(BASE).n, isnan=np.isnan,
    )  # fmt: skip
    write_whole(page, rendered)
    write_manifest(out, "trust", {
        "sources": [{"name": bench.name}], "dataset": bench.source, "condition": bench.condition,
        "rules": list(bench.rules), "attacks": list(bench.attacks), "shares": list(bench.shares),
        "versions": versions(),
    })  # fmt: skip
    return page
