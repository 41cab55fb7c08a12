"""The study of a grid: a heat map, success against latency, and tables of combinations and effects."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.figures import PLAIN, shown
from harness.core.versions import versions
from harness.evaluate.spec import Spec
from harness.report.compare.page import beside
from harness.report.document import Table, linked
from harness.report.drawing.colours import conditions
from harness.runs.metrics import LATENCY, SUCCESS
from harness.studies.figures.heat_map import heat_map
from harness.studies.figures.points import Steps, fronts
from harness.studies.grid import FIELDS, HALVES, Cell, Grid, Halves
from harness.studies.study import Study, ends, p_cell

if TYPE_CHECKING:
    import pandas as pd

MOST_EFFECTS = 8  # that a terminal shows


def grid_study(grid: Grid, spec: Spec, out: Path) -> Study:
    """Declare the study of a grid in its folder."""
    data, episodes = tables(grid), grid.cells[0].run.grid.episodes
    factors = "; ".join(f"{factor.name} ({', '.join(factor.levels)})" for factor in grid.factors)
    last, colours = grid.conditions[-1], conditions(grid.conditions)
    rates = {c: [100 * cell.estimate(SUCCESS, c).value for cell in grid.cells] for c in grid.conditions}
    steps = []
    for c, colour in colours.items():
        best = front(grid.cells, c)
        look: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 4}
        steps += [
            Steps(
                c, [cell.estimate(LATENCY, c).value for cell in grid.cells], rates[c],
                look | {"linestyle": ""},
            ),
            Steps(
                "", [cell.estimate(LATENCY, c).value for cell in best],
                [100 * cell.estimate(SUCCESS, c).value for cell in best], look, pair(grid, best[-1]),
            ),
        ]  # fmt: skip
    return Study(
        "grid", f"{grid.rows} egos × {grid.columns} helpers on {spec.source.name}", headline(grid),
        [
            f"Varied: {factors}. n = {len(episodes)} episodes × {len(spec.seeds)} channel seeds "
            f"({', '.join(map(str, spec.seeds))}), the same for all combinations, so differences are "
            "paired by episode; 95 % intervals are over episodes. All figures are in cells.csv and "
            "effects.csv; each combination's run is in cells/. The inference time is declared, or "
            "measured before the run; each run.json says which.",
            "The figure joins the combinations that no other beats in success without taking longer (◆). "
            "The best of many looks better than it is: choose on one set of seeds, and report on another.",
        ],
        [
            *(_cells(grid, c, out, c == last) for c in reversed(grid.conditions)),
            *(_effects(grid, c, c == last) for c in reversed(grid.conditions)),
        ],
        data,
        {
            "sources": [{"name": f"{grid.rows} egos × {grid.columns} helpers"}],
            "factors": {factor.name: list(factor.levels) for factor in grid.factors},
            "cells": [str(cell.run.path.relative_to(out)) for cell in grid.cells],
            "dataset": spec.source.name, "conditions": list(grid.conditions), "seeds": list(spec.seeds),
            "versions": versions(),
        },
        data,
        {
            "heat-map": heat_map(
                {c: np.array(rates[c]).reshape(grid.rows, grid.columns) for c in grid.conditions},
                [grid.name(grid.cells[i * grid.columns].ego, "ego") for i in range(grid.rows)],
                [grid.name(cell.helper, "helper") for cell in grid.cells[: grid.columns]], "ego", "helpers",
            ),
            "pareto": fronts([("", "latency of a decision, ms", steps)]),
        },
    )  # fmt: skip


def headline(grid: Grid) -> list[str]:
    """Say under each condition which half matters, or that none can be told to."""
    return [_halves(grid, h) if (h := grid.halves(c)) else _range(grid, c) for c in grid.conditions]


def _range(grid: Grid, condition: str) -> str:
    rates = [100 * cell.estimate(SUCCESS, condition).value for cell in grid.cells]
    effects = [effect for effect in grid.effects if effect.condition == condition]
    return (
        f"Under {condition}, the {len(rates)} combinations succeed in {min(rates):.1f} to {max(rates):.1f} % "
        f"of the episodes; {sum(e.clear for e in effects)} of {len(effects)} effects are more than chance "
        f"explains (n = {grid.cells[0].estimate(SUCCESS, condition).n})."
    )


def _halves(grid: Grid, h: Halves) -> str:
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


def front(cells: Sequence[Cell], condition: str) -> list[Cell]:
    """Return the cells that none beats in success without taking longer, fastest first."""
    taken: list[Cell] = []
    by_latency = sorted(
        cells, key=lambda c: (c.estimate(LATENCY, condition).value, -c.estimate(SUCCESS, condition).value)
    )
    for cell in by_latency:
        if (
            not taken
            or cell.estimate(SUCCESS, condition).value > taken[-1].estimate(SUCCESS, condition).value
        ):
            taken.append(cell)
    return taken


def pair(grid: Grid, cell: Cell) -> str:
    """Return ego and helpers of a cell, by what is varied."""
    return f"{grid.name(cell.ego, 'ego')} + {grid.name(cell.helper, 'helper')}"


def _cells(grid: Grid, condition: str, out: Path, terminal: bool) -> Table:
    best = {cell.run.path for cell in front(grid.cells, condition)}
    place, rows = beside(out / "index.html"), []
    for cell in sorted(grid.cells, key=lambda cell: -cell.estimate(SUCCESS, condition).value):
        run = f"cells/{cell.run.path.name}"
        latency = f"{cell.estimate(LATENCY, condition).value:.1f}{' ◆' * (cell.run.path in best)}"
        report = place(cell.run)
        rows.append((
            pair(grid, cell), shown(cell.estimate(SUCCESS, condition)), latency,
            PLAIN.number(cell.estimate("tokens", condition).value), f"{cell.ego.name} + {cell.helper.name}",
            linked(run, report),
        ))  # fmt: skip
    heads = ("ego + helpers", "success %, 95 % CI", "latency, ms", "tokens a decision", "agents", "run")
    note = "Tokens: of prompts and answers of the ego and every asked helper; a dash: a model counts none."
    return Table(condition, heads, rows, note, terminal=range(4) if terminal else ())


def _effects(grid: Grid, condition: str, terminal: bool) -> Table:
    known = [e for e in grid.effects if e.condition == condition and not np.isnan(e.estimate.value)]
    rows = [
        (e.what, shown(e.estimate), p_cell(e.p)) for e in sorted(known, key=lambda e: -abs(e.estimate.value))
    ]
    return Table(
        f"Effect of each choice, {condition}", ("effect", "points, 95 % CI", "p"), rows,
        "An effect is the difference in success when one factor changes, averaged over all other factors. "
        "An interaction (×) is half the difference between the effects of one factor at two levels of the "
        f"other. p comes from the interval and is corrected by Holm's method for all {len(grid.effects)} "
        "effects; bold: 0.05 or less.",
        terminal=range(3) if terminal else (), most=MOST_EFFECTS,
    )  # fmt: skip


def tables(grid: Grid) -> "dict[str, pd.DataFrame]":
    """Return `cells` and `effects` as data frames: an estimate with its interval a row."""
    import pandas as pd

    def who(cell: Cell) -> Mapping[str, str]:
        return {f"{half}_{field}": cell.level(half, field) for half in HALVES for field in FIELDS}

    cells = [
        {**who(cell), "run": cell.run.path.name, "condition": c, "metric": m, **ends(cell.estimate(m, c))}
        for cell in grid.cells for c in grid.conditions for m in cell.values
    ]  # fmt: skip
    effects = [
        {"condition": e.condition, "effect": e.what, **ends(e.estimate), "p_holm": e.p} for e in grid.effects
    ]
    return {"cells": pd.DataFrame(cells), "effects": pd.DataFrame(effects)}
