"""What a grid's folder has: heat maps, success against latency, tables and a page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.figures import PERCENT, PLAIN, shown
from harness.core.files import bytes_of, write_whole
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.evaluate.spec import Spec
from harness.report.compare.page import beside
from harness.report.drawing.colours import INK, PALE, conditions
from harness.report.drawing.pictures import styled
from harness.report.library import picture
from harness.report.page import environment
from harness.runs.metrics import LATENCY, SUCCESS
from harness.studies.grid import FIELDS, Cell, Effect, Grid, Halves, level
from harness.studies.study import write, write_manifest

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = Path(__file__).parent / "templates"
COSTS = {LATENCY: 1.0, "tokens": 1.0}


def in_a_sentence(grid: Grid) -> list[str]:
    """The result under each condition: which half matters, or that none can be told to."""
    return [_said(grid, h) if (h := grid.halves(c)) else _range(grid, c) for c in grid.conditions]


def _range(grid: Grid, condition: str) -> str:
    rates = [100 * cell.estimate(SUCCESS, condition).value for cell in grid.cells]
    effects = [effect for effect in grid.effects if effect.condition == condition]
    return (
        f"Under {condition}, the {len(rates)} combinations succeed in {min(rates):.1f} to {max(rates):.1f} % "
        f"of the episodes; {sum(e.clear for e in effects)} of {len(effects)} effects are more than chance "
        f"explains (n = {grid.cells[0].estimate(SUCCESS, condition).n})."
    )


def _said(grid: Grid, h: Halves) -> str:
    verdict = "neither choice clearly matters more"
    if h.apart.low > 0:
        verdict = "the choice of the ego matters more"
    elif h.apart.high < 0:
        verdict = "the choice of the helpers matters more"
    return (
        f"Under {h.condition}, {verdict}: the choice among {grid.rows} egos explains {shown(h.ego)} % of the "
        f"differences between the {len(grid.cells)} combinations, the choice among {grid.columns} helpers "
        f"{shown(h.helpers)} %, both together {shown(h.together)} % (n = {h.ego.n} episodes)."
    )


def text(metric: str, e: Estimate) -> str:
    """An estimate in a table: percent, or the metric's own unit; a dash where nothing is known."""
    return shown(e, PERCENT if metric == SUCCESS else PLAIN)


def front(cells: Sequence[Cell], condition: str) -> list[Cell]:
    """The cells that none beats in success without taking longer, fastest first."""
    found: list[Cell] = []
    best = -1.0
    by_latency = sorted(
        cells, key=lambda c: (c.estimate(LATENCY, condition).value, -c.estimate(SUCCESS, condition).value)
    )
    for cell in by_latency:
        if cell.estimate(SUCCESS, condition).value > best:
            best = cell.estimate(SUCCESS, condition).value
            found.append(cell)
    return found


@styled
def heat_map(grid: Grid) -> Figure:
    """Success of every combination, a panel a condition; egos are rows, helpers columns."""
    rows = [grid.name(grid.cells[i * grid.columns].ego, "ego") for i in range(grid.rows)]
    columns = [grid.name(cell.helper, "helper") for cell in grid.cells[: grid.columns]]
    width, height = 1.1 + 0.75 * grid.columns, 0.9 + 0.42 * grid.rows
    size = (width * len(grid.conditions) + 1.2, height + 0.08 * max(map(len, columns)))
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.08))
    panels = figure.subplots(1, len(grid.conditions), squeeze=False)[0]
    rates = {c: _matrix(grid, c) for c in grid.conditions}
    low, high = min(of.min() for of in rates.values()), max(of.max() for of in rates.values())
    for place, (axes, (condition, of)) in enumerate(zip(panels, rates.items(), strict=True)):
        axes.imshow(of, cmap="Blues", vmin=low - 0.1 * (high - low) - 1, vmax=high + 1, aspect="auto")
        axes.set_title(condition, fontsize=8)
        axes.set_xticks(range(grid.columns), columns, rotation=40, ha="right", fontsize=7)
        axes.set_yticks(range(grid.rows), rows if place == 0 else [], fontsize=7)
        axes.set_xlabel("helpers")
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        for (i, j), rate in np.ndenumerate(of):
            light = rate > (low + 2 * high) / 3 and high > low
            axes.text(j, i, f"{rate:.1f}", ha="center", va="center", color="white" if light else INK)
    panels[0].set_ylabel("ego")
    return figure


def _matrix(grid: Grid, condition: str) -> Any:
    rates = [100 * cell.estimate(SUCCESS, condition).value for cell in grid.cells]
    return np.array(rates).reshape(grid.rows, grid.columns)


@styled
def pareto(grid: Grid) -> Figure:
    """Success against the latency of a decision, a point a combination; lines join those that none beats."""
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axes = figure.subplots()
    for condition, colour in conditions(grid.conditions).items():
        points = np.array([_point(cell, condition) for cell in grid.cells])
        axes.plot(points[:, 0], points[:, 1], "o", color=colour, markersize=4, alpha=0.75, label=condition)
        best = front(grid.cells, condition)
        line = np.array([_point(cell, condition) for cell in best])
        axes.plot(line[:, 0], line[:, 1], drawstyle="steps-post", color=colour, linewidth=1)
        top = best[-1]
        name = f"{grid.name(top.ego, 'ego')} + {grid.name(top.helper, 'helper')}"
        axes.annotate(
            name, line[-1], xytext=(0, 5), textcoords="offset points", ha="center", fontsize=6.5, color=INK
        )
    axes.set(xlabel="latency of a decision, ms", ylabel="success, %")
    axes.margins(x=0.12, y=0.15)
    axes.grid(color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=7)
    return figure


def _point(cell: Cell, condition: str) -> tuple[float, float]:
    return cell.estimate(LATENCY, condition).value, 100 * cell.estimate(SUCCESS, condition).value


def tables(grid: Grid) -> "dict[str, pd.DataFrame]":
    """`cells` and `effects` as data frames: an estimate with its interval a row."""
    import pandas as pd

    def ends(e: Estimate) -> dict[str, Any]:
        return {"value": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n}

    def who(cell: Cell) -> dict[str, str]:
        halves = (("ego", cell.ego), ("helper", cell.helper))
        return {f"{half}_{field}": level(agent, field) for half, agent in halves for field in FIELDS}

    cells = [
        {**who(cell), "run": cell.run.path.name, "condition": c, "metric": m, **ends(cell.estimate(m, c))}
        for cell in grid.cells for c in grid.conditions for m in cell.values
    ]  # fmt: skip
    effects = [
        {"condition": e.condition, "effect": e.what, **ends(e.estimate), "p_holm": e.p} for e in grid.effects
    ]
    return {"cells": pd.DataFrame(cells), "effects": pd.DataFrame(effects)}


def write_grid(grid: Grid, spec: Spec, out: Path) -> Path:
    """Write pictures, tables and the page, `grid.json` last; returns the page's path."""
    drawn = {"heat-map": heat_map(grid), "pareto": pareto(grid)}
    write(out, drawn, tables(grid))
    page = out / "index.html"
    rendered = environment(TEMPLATES).get_template("grid.html.j2").render(
        grid=grid, sentences=in_a_sentence(grid), text=text, success=SUCCESS, latency=LATENCY,
        pictures={name: picture(bytes_of(out / f"{name}.svg", "picture")) for name in drawn},
        by_condition={c: ranked(grid, c) for c in grid.conditions}, fronts=_fronts(grid),
        effects=[e for e in grid.effects if not np.isnan(e.estimate.value)], source=spec.source.name,
        place=beside(page), seeds=spec.seeds, points=lambda e: text(SUCCESS, e.estimate),
    )  # fmt: skip
    write_whole(page, rendered)
    manifest = {
        "sources": [{"name": f"{grid.rows} egos × {grid.columns} helpers"}],
        "factors": {factor.name: list(factor.levels) for factor in grid.factors},
        "cells": [str(cell.run.path.relative_to(out)) for cell in grid.cells],
        "dataset": spec.source.name, "conditions": list(grid.conditions), "seeds": list(spec.seeds),
        "versions": versions(),
    }  # fmt: skip
    write_manifest(out, "grid", manifest)
    return page


def ranked(grid: Grid, condition: str) -> list[Cell]:
    """The cells, the most successful under a condition first."""
    return sorted(grid.cells, key=lambda cell: -cell.estimate(SUCCESS, condition).value)


def _fronts(grid: Grid) -> dict[str, set[Path]]:
    return {c: {cell.run.path for cell in front(grid.cells, c)} for c in grid.conditions}


def strongest(effects: Sequence[Effect], condition: str, most: int) -> list[Effect]:
    """The effects under a condition that are known, the largest first."""
    known = [e for e in effects if e.condition == condition and not np.isnan(e.estimate.value)]
    return sorted(known, key=lambda e: -abs(e.estimate.value))[:most]
