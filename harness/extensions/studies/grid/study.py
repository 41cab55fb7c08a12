"""`harness study grid`: every ego agent with every helper agent, and what each choice is worth.

A full factorial design: a cell is a run of one ego agent with one helper agent. Cells share
answers, so each agent is asked in each role once about a decision point, whatever cell comes to it.
All cells have the same episodes and the same draws, so contrasts are paired by episode.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.backends.registry import open_backend
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.figures import PLAIN, crossed, shown
from harness.core.multiplicity import LEVEL
from harness.core.progress import Progress
from harness.core.statistics import Estimate, resampled_estimate
from harness.core.versions import versions
from harness.evaluate.agent import Agent
from harness.evaluate.run import read_or_evaluate
from harness.evaluate.spec import Spec
from harness.report.compare.page import beside
from harness.report.document import Table, linked
from harness.report.drawing.colours import conditions
from harness.runs.folder import Run
from harness.runs.leading import lead_of
from harness.runs.metrics import LATENCY, METRICS, SUCCESS, by_episode, mean_by_place, over_episodes
from harness.runs.records import Answer, is_helper
from harness.runs.success import Success
from harness.studies.study import Study, corrected, ends, p_cell

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RESAMPLES = 4000
FIELDS = ("model", "prompt", "answer")
HALVES = ("ego", "helper")


@dataclass(frozen=True)
class Factor:
    """What one half of a swarm chooses."""

    half: str  # whose it is, `ego` or `helper`
    field: str  # `model`, `prompt` or `answer`
    levels: tuple[str, ...]  # what it may be, the base first

    @property
    def name(self) -> str:
        """For tables: `helper prompt`."""
        return f"{self.half} {self.field}"


@dataclass(frozen=True)
class Cell:
    """A combination: the ego's agent, the helpers', and their run."""

    ego: Agent
    helper: Agent
    run: Run

    def level(self, half: str, field: str) -> str:
        """Return the level of a factor."""
        return level(self.ego if half == "ego" else self.helper, field)

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """Success, latency and tokens of a decision, each (C, S, E); NaN where unknown."""
        run = self.run
        values = by_episode(
            [METRICS[SUCCESS], METRICS[LATENCY]], run.grid, run.decisions, run.episodes
        )
        places, n = run.grid.places(run.decisions), len(run.episodes)
        return {**values, "tokens": mean_by_place(tokens(run), places, n).reshape(run.grid.shape)}

    def estimate(self, metric: str, condition: str) -> Estimate:
        """Return a metric under a condition, over episodes."""
        return over_episodes(metric, self.values[metric][self.run.conditions.index(condition)])


@dataclass(frozen=True)
class Effect:
    """What a change of level is worth in what leads, averaged over all other factors."""

    condition: str  # the operating point
    what: str  # the factor and its two levels; two of them for an interaction
    # b - a of a main effect; of an interaction half the difference of two such differences
    estimate: Estimate
    # of no effect, by Holm's method corrected for all effects of the grid; None without an interval
    p: float | None

    @property
    def clear(self) -> bool:
        """Whether it is more than chance explains."""
        return self.p is not None and self.p <= LEVEL


@dataclass(frozen=True)
class Halves:
    """Shares of the variance of what leads between the cells that each half explains.

    What episodes by chance add is taken off, as a bootstrap over episodes says;
    so are intervals made.
    """

    condition: str  # the operating point
    ego: Estimate  # which agent the ego has
    helpers: Estimate  # which the helpers have
    together: Estimate  # their interaction, the rest
    apart: Estimate  # `ego` - `helpers`


def level(agent: Agent, field: str) -> str:
    """Return a factor's level that an agent has."""
    return {"model": agent.card.name, "prompt": agent.prompt.version, "answer": agent.answer}[field]


def tokens(run: Run) -> Floats:
    """Return tokens in and out that a decision took,
    of the ego and of each helper that was to reply, (n,).

    NaN throughout where a model of the run counts none.
    """
    by_scene: dict[str | None, dict[str, list[float]]] = {}
    for answer in run.answers:
        counts = (answer.prompt_tokens, answer.completion_tokens)
        total = math.nan if None in counts else float(sum(c or 0 for c in counts))
        by_scene.setdefault(answer.scene, {}).setdefault(answer.role, []).append(total)
    means = {
        scene: [float(np.mean(roles.get(role, [0.0]))) for role in HALVES]
        for scene, roles in by_scene.items()
    }
    ego, helper = np.array([means[scene] for scene in run.decisions.labels("scene")]).T
    messages = run.decisions["messages"]
    total = ego + np.where(messages > 0, messages * helper, 0.0)
    return np.full_like(total, np.nan) if np.isnan(total).any() else total


def run_cells(
    spec: Spec,
    egos: Sequence[Agent],
    helpers: Sequence[Agent],
    out: Path,
    progress: Progress,
    cache_file: Path | None,
) -> "Grid":
    """Evaluate every combination in a folder of its own under `out`; those that are there stay.

    Completions are kept between runs in the cache file, if there is one.

    Raises:
        UserError: the folder holds another grid, or a model is not available.
    """
    opens, asked = cache(open_backend), dict[tuple[str, str], dict[str, Answer]]()
    cells = []
    pairs = list(product(enumerate(egos, 1), enumerate(helpers, 1)))
    # All are checked first.
    specs = [replace(spec, ego=ego, helpers=(helper,)) for (_, ego), (_, helper) in pairs]
    for ((i, ego), (j, helper)), both in zip(pairs, specs, strict=True):
        given = {
            name: answer
            for (role, of_agent), answers in asked.items()
            if of_agent == (helper.name if is_helper(role) else ego.name)
            for name, answer in answers.items()
        }
        folder = out / "cells" / f"{i}-{j}"
        run = read_or_evaluate(both, folder, progress, cache_file, opens, given)
        for answer in run.answers:
            if answer.role != "merge" and answer.error is None:
                of_agent = helper.name if is_helper(answer.role) else ego.name
                asked.setdefault((answer.role, of_agent), {})[answer.id] = answer
        cells.append(Cell(ego, helper, run))
    runs = [cell.run for cell in cells]
    episodes = runs[0].episodes[: len(runs[0].grid.episodes)]
    return Grid(tuple(cells), len(egos), len(helpers), Success.of(episodes, lead_of(*runs)))


@dataclass(frozen=True)
class Grid:
    """All cells of a full factorial design, row by row:
    `rows` ego agents, `columns` helper agents.
    """

    cells: tuple[Cell, ...]
    rows: int
    columns: int
    counting: Success  # of all cells

    def __post_init__(self) -> None:
        if len({(cell.run.conditions, cell.run.grid) for cell in self.cells}) > 1:
            raise UserError(
                f"{printable(self.cells[0].run.path.parent)}: its runs are not of the same grid"
            )

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the operating points."""
        return self.cells[0].run.conditions

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """What has more than one level."""
        every = (
            Factor(half, field, tuple(dict.fromkeys(c.level(half, field) for c in self.cells)))
            for half, field in product(HALVES, FIELDS)
        )
        return tuple(factor for factor in every if len(factor.levels) > 1)

    def success(self, cell: Cell, condition: str) -> Estimate:
        """Return what leads of a cell under a condition."""
        return self.counting.estimate(cell.values[SUCCESS][self.conditions.index(condition)])

    def name(self, agent: Agent, half: str) -> str:
        """Return an agent by what is varied of its half; by its model where nothing is."""
        varied = [factor.field for factor in self.factors if factor.half == half]
        return " ".join(level(agent, field) for field in varied or ("model",))

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Main effects and interactions of two factors on success, under every condition."""
        contrasts = [
            (condition, *contrast)
            for condition in self.conditions
            for contrast in (*self._main(condition), *self._interactions(condition))
        ]
        p_values = corrected([self.counting.p_value(high, low) for _, _, low, high in contrasts])
        return tuple(
            Effect(condition, what, self.counting.difference(high, low), p)
            for (condition, what, low, high), p in zip(contrasts, p_values, strict=True)
        )

    def _mean(self, condition: str, **levels: str) -> Floats:
        """Return mean success of the cells with these levels, by factor's name, (S, E)."""
        at = self.conditions.index(condition)
        having = [
            cell.values[SUCCESS][at]
            for cell in self.cells
            if all(cell.level(*name.split()) == wanted for name, wanted in levels.items())
        ]
        return np.asarray(np.mean(having, axis=0))

    def _main(self, condition: str) -> Iterator[tuple[str, Floats, Floats]]:
        for factor in self.factors:
            base, *levels = factor.levels
            for new_level in levels:
                low, high = (self._mean(condition, **{factor.name: at}) for at in (base, new_level))
                yield f"{factor.name}: {base} → {new_level}", low, high

    def _interactions(self, condition: str) -> Iterator[tuple[str, Floats, Floats]]:
        for a, b in combinations(self.factors, 2):
            for x, y in product(a.levels[1:], b.levels[1:]):
                low_low, low_high, high_low, high_high = (
                    self._mean(condition, **{a.name: of_a, b.name: of_b})
                    for of_a, of_b in product((a.levels[0], x), (b.levels[0], y))
                )
                name = f"{a.name} → {x} × {b.name} → {y}"
                yield name, (high_low + low_high) / 2, (low_low + high_high) / 2

    def halves(self, condition: str) -> Halves | None:
        """Return what each half explains;
        None without a channel, if one varies, or if all may be alike.
        """
        at = self.conditions.index(condition)
        if (
            1 in (self.rows, self.columns)
            or not self.cells[0].run.manifest.conditions[at]["profile"]
        ):
            return None
        each = np.array([np.mean(cell.values[SUCCESS][at], axis=0) for cell in self.cells])
        n = each.shape[1]
        counts = self.counting.resampled(noise.generator("grid", "halves"), RESAMPLES)
        weights = self.counting.weights(counts)
        squares = _squares((each @ weights.T).reshape(self.rows, self.columns, -1))
        # Episodes by chance add as much to the squares of what was played as resampling adds to
        # those.
        by_chance = squares[:, 1:].mean(axis=1) - squares[:, 0]
        times = np.where(np.arange(RESAMPLES + 1) > 0, 2, 1)
        shares = _shares(np.maximum(squares - times * by_chance[:, None], 0.0))
        if np.isnan(shares[:, 0]).any() or np.isnan(shares[0]).mean() > LEVEL:
            return None
        return Halves(condition, *(resampled_estimate(share, n) for share in shares))


def _squares(means: Floats) -> Floats:
    """Of means (I, J, B): sums of squares of rows, of columns, and of what is left, (3, B)."""
    grand = means.mean(axis=(0, 1))
    rows = means.shape[1] * ((means.mean(axis=1) - grand) ** 2).sum(axis=0)
    columns = means.shape[0] * ((means.mean(axis=0) - grand) ** 2).sum(axis=0)
    return np.array([rows, columns, ((means - grand) ** 2).sum(axis=(0, 1)) - rows - columns])


def _shares(squares: Floats) -> Floats:
    """The share of each of the three, and the first less the second, (4, B);
    NaN where there is nothing.
    """
    total = squares.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = np.where(total > 1e-12, squares / total, np.nan)
    return np.concatenate([parts, parts[:1] - parts[1:2]])


MOST_EFFECTS = 8  # that a terminal shows


def grid_study(grid: Grid, spec: Spec, out: Path) -> Study:
    """Declare the study of a grid in its folder."""
    data, episodes = tables(grid), grid.cells[0].run.grid.episodes
    factors = "; ".join(f"{factor.name} ({', '.join(factor.levels)})" for factor in grid.factors)
    last = grid.conditions[-1]
    return Study(
        "grid",
        f"{grid.rows} egos × {grid.columns} helpers on {spec.source.name}",
        headline(grid),
        [
            f"Varied: {factors}. n = {crossed(len(episodes), len(spec.seeds))} "
            f"({', '.join(map(str, spec.seeds))}), the same for all combinations, so differences "
            "are paired by episode; 95 % intervals are over episodes. All figures are in "
            "cells.csv and effects.csv; each combination's run is in cells/. The inference time "
            "is declared, or measured before the run; each run.json says which.",
            "The figure joins the combinations that no other beats in success without taking "
            "longer (◆). The best of many looks better than it is: choose on one set of seeds, "
            "and report on another.",
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
            "dataset": spec.source.name,
            "conditions": list(grid.conditions),
            "seeds": list(spec.seeds),
            "versions": versions(),
        },
        data,
        lambda: _figures(grid),
    )


def _figures(grid: Grid) -> "dict[str, Figure]":
    """Draw success of every combination, and against its latency, where the best are joined."""
    from harness.studies.figures.heat_map import heat_map
    from harness.studies.figures.points import Steps, fronts

    rates = {c: [100 * grid.success(cell, c).value for cell in grid.cells] for c in grid.conditions}
    steps = []
    for c, colour in conditions(grid.conditions).items():
        best = front(grid, c)
        look: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 4}
        steps += [
            Steps(
                c,
                [cell.estimate(LATENCY, c).value for cell in grid.cells],
                rates[c],
                look | {"linestyle": ""},
            ),
            Steps(
                "",
                [cell.estimate(LATENCY, c).value for cell in best],
                [100 * grid.success(cell, c).value for cell in best],
                look,
                pair(grid, best[-1]),
            ),
        ]
    return {
        "heat-map": heat_map(
            {c: np.array(rates[c]).reshape(grid.rows, grid.columns) for c in grid.conditions},
            [grid.name(grid.cells[i * grid.columns].ego, "ego") for i in range(grid.rows)],
            [grid.name(cell.helper, "helper") for cell in grid.cells[: grid.columns]],
            "ego",
            "helpers",
        ),
        "pareto": fronts([("", "latency of a decision, ms", steps)], grid.counting.words),
    }


def headline(grid: Grid) -> list[str]:
    """Say under each condition which half matters, or that none can be told to."""
    return [_halves(grid, h) if (h := grid.halves(c)) else _range(grid, c) for c in grid.conditions]


def _range(grid: Grid, condition: str) -> str:
    rates = [100 * grid.success(cell, condition).value for cell in grid.cells]
    effects = [effect for effect in grid.effects if effect.condition == condition]
    return (
        f"Under {condition}, {grid.counting.words} of the {len(rates)} combinations is "
        f"{min(rates):.1f} to {max(rates):.1f} %; {sum(e.clear for e in effects)} of "
        f"{len(effects)} effects are more than chance explains (n = "
        f"{grid.success(grid.cells[0], condition).n})."
    )


def _halves(grid: Grid, h: Halves) -> str:
    verdict = "neither choice clearly matters more"
    if h.apart.low > 0:
        verdict = "the choice of the ego matters more"
    elif h.apart.high < 0:
        verdict = "the choice of the helpers matters more"
    return (
        f"Under {h.condition}, {verdict}: the choice among {grid.rows} egos explains "
        f"{shown(h.ego)} % of the differences in {grid.counting.words} between the "
        f"{len(grid.cells)} combinations, the choice among {grid.columns} helpers "
        f"{shown(h.helpers)} %, both together {shown(h.together)} % (n = {h.ego.n} episodes)."
    )


def front(grid: Grid, condition: str) -> list[Cell]:
    """Return the cells that none beats in success without taking longer, fastest first."""

    def success(cell: Cell) -> float:
        return grid.success(cell, condition).value

    taken: list[Cell] = []
    for cell in sorted(
        grid.cells, key=lambda cell: (cell.estimate(LATENCY, condition).value, -success(cell))
    ):
        if not taken or success(cell) > success(taken[-1]):
            taken.append(cell)
    return taken


def pair(grid: Grid, cell: Cell) -> str:
    """Return ego and helpers of a cell, by what is varied."""
    return f"{grid.name(cell.ego, 'ego')} + {grid.name(cell.helper, 'helper')}"


def _cells(grid: Grid, condition: str, out: Path, terminal: bool) -> Table:
    best = {cell.run.path for cell in front(grid, condition)}
    place, rows = beside(out / "index.html"), []
    for cell in sorted(grid.cells, key=lambda cell: -grid.success(cell, condition).value):
        run = f"cells/{cell.run.path.name}"
        latency = f"{cell.estimate(LATENCY, condition).value:.1f}{' ◆' * (cell.run.path in best)}"
        report = place(cell.run)
        rows.append(
            (
                pair(grid, cell),
                shown(grid.success(cell, condition)),
                latency,
                PLAIN.number(cell.estimate("tokens", condition).value),
                f"{cell.ego.name} + {cell.helper.name}",
                linked(run, report),
            )
        )
    heads = (
        "ego + helpers",
        f"{grid.counting.words} %, 95 % CI",
        "latency, ms",
        "tokens a decision",
        "agents",
        "run",
    )
    note = (
        "Tokens: of prompts and answers of the ego and every asked helper; a dash: a model counts "
        "none."
    )
    return Table(condition, heads, rows, note, terminal=range(4) if terminal else ())


def _effects(grid: Grid, condition: str, terminal: bool) -> Table:
    known = [e for e in grid.effects if e.condition == condition and not np.isnan(e.estimate.value)]
    rows = [
        (e.what, shown(e.estimate), p_cell(e.p))
        for e in sorted(known, key=lambda e: -abs(e.estimate.value))
    ]
    return Table(
        f"Effect of each choice, {condition}",
        ("effect", "points, 95 % CI", "p"),
        rows,
        f"An effect is the difference in {grid.counting.words} when one factor changes, averaged "
        "over all other factors. An interaction (×) is half the difference between the effects "
        "of one factor at two levels of the other. p comes from the interval and is corrected by "
        f"Holm's method for all {len(grid.effects)} effects; bold: 0.05 or less.",
        terminal=range(3) if terminal else (),
        most=MOST_EFFECTS,
    )


def tables(grid: Grid) -> "dict[str, pd.DataFrame]":
    """Return `cells` and `effects` as data frames: an estimate with its interval a row."""
    import pandas as pd

    def who(cell: Cell) -> Mapping[str, str]:
        return {f"{half}_{field}": cell.level(half, field) for half in HALVES for field in FIELDS}

    cells = [
        {
            **who(cell),
            "run": cell.run.path.name,
            "condition": c,
            "metric": m,
            **ends(cell.estimate(m, c)),
        }
        for cell in grid.cells
        for c in grid.conditions
        for m in cell.values
    ]
    if (lead := grid.counting.metric) != SUCCESS:
        cells += [
            {
                **who(cell),
                "run": cell.run.path.name,
                "condition": c,
                "metric": lead,
                **ends(grid.success(cell, c)),
            }
            for cell in grid.cells
            for c in grid.conditions
        ]
    effects = [
        {"condition": e.condition, "effect": e.what, **ends(e.estimate), "p_holm": e.p}
        for e in grid.effects
    ]
    return {"cells": pd.DataFrame(cells), "effects": pd.DataFrame(effects)}
