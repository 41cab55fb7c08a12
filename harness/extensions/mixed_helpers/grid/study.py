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
from harness.core.figures import PLAIN, crossed, interval_of
from harness.core.files import folder_in
from harness.core.multiplicity import LEVEL
from harness.core.progress import Progress
from harness.core.statistics import Estimate, joined_clusters, resampled_estimate
from harness.core.versions import versions
from harness.evaluate.agent import Agent
from harness.evaluate.run import read_or_evaluate
from harness.evaluate.spec import Spec
from harness.report.compare.page import beside
from harness.report.document import Table, linked
from harness.report.drawing.colours import conditions
from harness.runs.alike import refuse_two_of_a_name
from harness.runs.estimates import over_episodes
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS, headline_of
from harness.runs.metric_names import LATENCY
from harness.runs.metric_values import by_episode
from harness.runs.metrics import METRICS
from harness.runs.places import mean_by_place
from harness.runs.records import Answer, is_helper
from harness.runs.success import Success
from harness.studies.figures.described import Draws, Steps
from harness.studies.study import Study, corrected, ends, p_cell

if TYPE_CHECKING:
    import pandas as pd

RESAMPLES = 4000
FIELDS = ("model", "prompt", "answer")
HALVES = ("ego", "helper")


@dataclass(frozen=True)
class Factor:
    """Describe one thing that the grid of runs varies, such as the helpers' prompt version.

    The grid has a run of each choice for the ego with each choice for its helpers. An answer mode
    is a way to answer, such as free text or one letter.
    """

    half: str  # whose it is: `ego` or `helper`
    field: str  # `model`, `prompt` or `answer`
    levels: tuple[str, ...]  # its values in the grid; effects are measured from the first

    @property
    def name(self) -> str:
        """Return the factor's name for tables, such as `helper prompt`.

        A factor is what the grid of runs varies, such as the helpers' model, and a level one of its
        values.
        """
        return f"{self.half} {self.field}"


@dataclass(frozen=True)
class Cell:
    """Hold one cell of a grid of runs: an ego agent, a helper agent, and their run.

    An agent is a model with a prompt version and an answer mode. The grid has a run of every ego
    agent with every helper agent.
    """

    ego: Agent  # who answers for the ego
    helper: Agent  # who answers for each helper
    run: Run  # their finished run

    def level(self, half: str, field: str) -> str:
        """Return what a cell has of something that the grid varies, such as the model's name.

        A cell is a run of one ego agent with one helper agent, each a model with a prompt version
        and an answer mode. `half` is `ego` or `helper`, and `field` is `model`, `prompt` or
        `answer`.
        """
        return level(self.ego if half == "ego" else self.helper, field)

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """Return success (0 to 1), latency (ms) and tokens, by metric, each an array (C, S, E).

        The axes are C conditions (settings of radio, asking and fusion), S channel seeds and E
        episodes. Latency and tokens are means over an episode's decisions; unknown values are NaN.
        """
        run = self.run
        metrics = [METRICS[SUCCESS], METRICS[LATENCY]]
        values = by_episode(metrics, run.grid, run.decisions, run.episodes)
        places = run.grid.places(run.decisions)
        of_episodes = mean_by_place(tokens(run), places, len(run.episodes))
        return {**values, "tokens": of_episodes.reshape(run.grid.shape)}

    def estimate(self, metric: str, condition: str) -> Estimate:
        """Return a metric's mean under a condition, with its 95 % interval over episodes.

        `metric` names success, latency (ms) or tokens, a key of `values`. `condition` is the name
        of a set of settings of radio, asking and fusion in the run.
        """
        values = self.values[metric][self.run.conditions.index(condition)]
        return over_episodes(metric, values, self.run.clusters)


@dataclass(frozen=True)
class Effect:
    """Describe how success, the headline metric, changes with a factor, averaged over all others.

    A factor is what the grid of runs varies, such as the ego's prompt version or the helpers'
    model, and a level one of its values.
    """

    # name of the settings of radio, asking and fusion
    condition: str
    what: str  # the factor and its two levels, in words; for an interaction, two factors
    # second level minus first; for an interaction, half the difference of two such differences
    estimate: Estimate
    # p-value of no effect, corrected by Holm's method for all effects of the grid; None without an
    # interval
    p: float | None

    @property
    def clear(self) -> bool:
        """Return whether the effect is clear: its corrected p-value is at most 0.05."""
        return self.p is not None and self.p <= LEVEL


@dataclass(frozen=True)
class Halves:
    """Hold how much of the differences in success is due to the ego's choice, and to the helpers'.

    The choices are agents: a model with a prompt version and an answer mode each; a cell is a run
    of one ego agent with one helper agent. Shares, 0 to 1, are of the variance of success over the
    cells. What the random choice of episodes adds is taken off, as estimated by a bootstrap over
    episodes, which also makes the intervals.
    """

    # name of the settings of radio, asking and fusion
    condition: str
    ego: Estimate  # share explained by the ego's agent
    helpers: Estimate  # share explained by the helpers' agent
    together: Estimate  # share of their interaction, which is the rest
    apart: Estimate  # `ego` - `helpers`


def level(agent: Agent, field: str) -> str:
    """Return an agent's model name, prompt version or answer mode, as a grid of runs varies them.

    An agent is a model with a prompt version and an answer mode. `field` is `model`, `prompt` or
    `answer`.
    """
    return {"model": agent.card.name, "prompt": agent.prompt.version, "answer": agent.answer}[field]


def tokens(run: Run) -> Floats:
    """Return prompt and completion tokens of each decision of a run, (n,).

    They are those of the ego and of each helper that was asked; NaN for all if one answer of the
    run has no count.
    """
    by_scene: dict[str | None, dict[str, list[float]]] = {}
    for answer in run.answers:
        counts = (answer.prompt_tokens, answer.completion_tokens)
        total = math.nan if None in counts else float(sum(c or 0 for c in counts))
        by_scene.setdefault(answer.scene, {}).setdefault(answer.role, []).append(total)
    means = {}
    for scene, by_role in by_scene.items():
        means[scene] = [float(np.mean(by_role.get(role, [0.0]))) for role in HALVES]
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
    """Run every combination of ego and helper agents, and return the grid of their runs.

    An agent is a model with a prompt version and an answer mode. A combination is one run, in which
    one agent answers for the ego and the other for all helpers. Finished runs are read, and all
    combinations share answers.

    Args:
        spec: the evaluation whose other settings all have.
        egos: the agents to answer for the ego.
        helpers: the agents to answer for helpers.
        out: the study's folder; each run gets a folder below it.
        progress: is called with the number of items just done in a run.
        cache_file: file of stored completions; None for no cache.

    Raises:
        UserError: the folder holds another grid, or a model is not available.
    """
    opens = cache(open_backend)
    answers: dict[tuple[str, str], dict[str, Answer]] = {}  # by role and agent, then by id
    cells, runs = list[Cell](), list[Run]()
    pairs = list(product(enumerate(egos, 1), enumerate(helpers, 1)))
    # All are checked first.
    specs = [replace(spec, ego=ego, helpers=(helper,)) for (_, ego), (_, helper) in pairs]
    for ((i, ego), (j, helper)), both in zip(pairs, specs, strict=True):
        stored: dict[str, Answer] = {}
        for (role, of_agent), of_role in answers.items():
            if of_agent == (helper.name if is_helper(role) else ego.name):
                stored |= of_role
        folder = folder_in(out, "cells") / f"{i}-{j}"
        run = read_or_evaluate(both, folder, progress, cache_file, opens, stored)
        refuse_two_of_a_name([*runs, run])
        runs.append(run)
        for answer in run.answers:
            if answer.role != "merge" and answer.error is None:
                of_agent = helper.name if is_helper(answer.role) else ego.name
                answers.setdefault((answer.role, of_agent), {})[answer.id] = answer
        cells.append(Cell(ego, helper, run))
    episodes = runs[0].episodes[: len(runs[0].grid.episodes)]
    clusters = joined_clusters([run.cluster_names for run in runs])
    rule = replace(Success.of(episodes, headline_of(*runs)), clusters=clusters)
    return Grid(tuple(cells), len(egos), len(helpers), rule)


@dataclass(frozen=True)
class Grid:
    """Hold all runs of a full factorial design: every ego agent with every helper agent.

    An agent is a model with a prompt version and an answer mode; there are `rows` ego agents and
    `columns` helper agents, and `cells` has their runs row by row. `success_rule` says how success
    is averaged over episodes, such as balanced over those with a danger (a vehicle that the ego
    would meet) and without.
    """

    cells: tuple[Cell, ...]  # row by row
    rows: int  # number of ego agents
    columns: int  # number of helper agents
    success_rule: Success  # how success of every cell is averaged, such as balanced by danger

    def __post_init__(self) -> None:
        if len({(cell.run.conditions, cell.run.grid) for cell in self.cells}) > 1:
            raise UserError(
                f"{printable(self.cells[0].run.path.parent)}: its runs are not of the same grid"
            )

    @property
    def conditions(self) -> tuple[str, ...]:
        """Return the names of the conditions that all runs have.

        A condition is a named set of settings of radio, asking and fusion.
        """
        return self.cells[0].run.conditions

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """Return what varies over the grid: model, prompt or answer mode, of ego or helpers.

        Only what has several values is a factor. An answer mode is a way to answer, such as free
        text or one letter.
        """
        factors = []
        for half, field in product(HALVES, FIELDS):
            levels = tuple(dict.fromkeys(cell.level(half, field) for cell in self.cells))
            if len(levels) > 1:
                factors.append(Factor(half, field, levels))
        return tuple(factors)

    def success(self, cell: Cell, condition: str) -> Estimate:
        """Return a cell's mean success, 0 to 1, under a condition, with its interval over episodes.

        A cell is a run of one ego agent with one helper agent, each a model with a prompt version
        and an answer mode. The condition is the name of a set of settings of radio, asking and
        fusion.
        """
        return self.success_rule.estimate(cell.values[SUCCESS][self.conditions.index(condition)])

    def name(self, agent: Agent, half: str) -> str:
        """Return a short name of an agent: what of it varies in the grid, else its model.

        An agent is a model with a prompt version and an answer mode. `half` is `ego` or `helper`,
        for whom it answers.
        """
        varied = [factor.field for factor in self.factors if factor.half == half]
        return " ".join(level(agent, field) for field in varied or ("model",))

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Return how success changes with each thing that the grid varies, and with pairs of them.

        These factors are model, prompt and answer mode of ego or helpers. Each effect is under one
        condition, a named set of settings of radio, asking and fusion, and measured from the
        factor's first value; p-values are corrected together.
        """
        effects, p_values = list[Effect](), list[float | None]()
        for condition in self.conditions:
            for name, low, high in (*self._main(condition), *self._interactions(condition)):
                estimate = self.success_rule.difference(high, low)
                effects.append(Effect(condition, name, estimate, None))
                p_values.append(self.success_rule.p_value(high, low))
        pairs = zip(effects, corrected(p_values), strict=True)
        return tuple(replace(effect, p=p) for effect, p in pairs)

    def _mean(self, condition: str, **levels: str) -> Floats:
        """Return mean success of the cells with these levels, by factor's name, (S, E)."""
        place = self.conditions.index(condition)
        wanted = [(*name.split(), level) for name, level in levels.items()]
        successes = []
        for cell in self.cells:
            if all(cell.level(half, field) == level for half, field, level in wanted):
                successes.append(cell.values[SUCCESS][place])
        return np.asarray(np.mean(successes, axis=0))

    def _main(self, condition: str) -> Iterator[tuple[str, Floats, Floats]]:
        for factor in self.factors:
            base, *levels = factor.levels
            low = self._mean(condition, **{factor.name: base})
            for new_level in levels:
                high = self._mean(condition, **{factor.name: new_level})
                yield f"{factor.name}: {base} → {new_level}", low, high

    def _interactions(self, condition: str) -> Iterator[tuple[str, Floats, Floats]]:
        for a, b in combinations(self.factors, 2):
            for x, y in product(a.levels[1:], b.levels[1:]):
                low_low = self._mean(condition, **{a.name: a.levels[0], b.name: b.levels[0]})
                low_high = self._mean(condition, **{a.name: a.levels[0], b.name: y})
                high_low = self._mean(condition, **{a.name: x, b.name: b.levels[0]})
                high_high = self._mean(condition, **{a.name: x, b.name: y})
                name = f"{a.name} → {x} × {b.name} → {y}"
                yield name, (high_low + low_high) / 2, (low_low + high_high) / 2

    def halves(self, condition: str) -> Halves | None:
        """Return how much of the differences in success is due to ego and helpers.

        They are shares of the variance over cells, runs of one ego agent (model, prompt version and
        answer mode) with one helper agent. `condition` is the name of a set of settings of radio,
        asking and fusion. The result is None if that has no radio channel, if only one of both
        varies, or if the cells may all be equal.
        """
        at = self.conditions.index(condition)
        if (
            1 in (self.rows, self.columns)
            or not self.cells[0].run.manifest.conditions[at]["profile"]
        ):
            return None
        each = np.array([np.mean(cell.values[SUCCESS][at], axis=0) for cell in self.cells])
        n = each.shape[1]
        counts = self.success_rule.resampled(noise.generator("grid", "halves"), RESAMPLES)
        weights = self.success_rule.weights(counts)
        squares = _squares((each @ weights.T).reshape(self.rows, self.columns, -1))
        # Episodes by chance add as much to the squares of what was played as resampling adds to
        # those.
        by_chance = squares[:, 1:].mean(axis=1) - squares[:, 0]
        times = np.where(np.arange(RESAMPLES + 1) > 0, 2, 1)
        shares = _shares(np.maximum(squares - times * by_chance[:, None], 0.0))
        if np.isnan(shares[:, 0]).any() or np.isnan(shares[0]).mean() > LEVEL:
            return None
        clusters = self.success_rule.clusters
        return Halves(condition, *(resampled_estimate(share, n, clusters) for share in shares))


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
    """Return the study of a grid of ego and helper agents: tables, pictures and sentences.

    An agent is a model with a prompt version and an answer mode. The runs lie in folders under
    `out`, and all share the settings of the evaluation `spec`.
    """
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
        lambda draws: _figures(draws, grid),
    )


def _figures(draws: Draws[Any], grid: Grid) -> dict[str, Any]:
    """Draw success of every combination, and against its latency, where the best are joined."""

    def latencies_ms(cells: Sequence[Cell], condition: str) -> list[float]:
        return [cell.estimate(LATENCY, condition).value for cell in cells]

    def percents(cells: Sequence[Cell], condition: str) -> list[float]:
        return [100 * grid.success(cell, condition).value for cell in cells]

    panels, steps = {}, []
    for name, colour in conditions(grid.conditions).items():
        rates, best = percents(grid.cells, name), front(grid, name)
        panels[name] = np.array(rates).reshape(grid.rows, grid.columns)
        steps.append(Steps(name, latencies_ms(grid.cells, name), rates, colour, "", "o"))
        x, y = latencies_ms(best, name), percents(best, name)
        steps.append(Steps("", x, y, colour, marker="o", name=pair(grid, best[-1])))
    egos = [grid.name(cell.ego, "ego") for cell in grid.cells[:: grid.columns]]
    helpers = [grid.name(cell.helper, "helper") for cell in grid.cells[: grid.columns]]
    return {
        "heat-map": draws.heat_map(panels, egos, helpers, "ego", "helpers"),
        "pareto": draws.fronts([("", "latency of a decision, ms", steps)], grid.success_rule.words),
    }


def headline(grid: Grid) -> list[str]:
    """Return a sentence for each condition: whether the choice of ego or helpers matters more.

    `grid` has a run of each ego agent with each helper agent; an agent is a model with a prompt
    version and an answer mode. A condition is a named set of settings of radio, asking and fusion.
    """
    sentences = []
    for condition in grid.conditions:
        halves = grid.halves(condition)
        sentences.append(_halves(grid, halves) if halves else _range(grid, condition))
    return sentences


def _range(grid: Grid, condition: str) -> str:
    rates = [100 * grid.success(cell, condition).value for cell in grid.cells]
    effects = [effect for effect in grid.effects if effect.condition == condition]
    return (
        f"Under {condition}, {grid.success_rule.words} of the {len(rates)} combinations is "
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
        f"{interval_of(h.ego)} % of the differences in {grid.success_rule.words} between the "
        f"{len(grid.cells)} combinations, the choice among {grid.columns} helpers "
        f"{interval_of(h.helpers)} %, both together {interval_of(h.together)} % "
        f"(n = {h.ego.n} episodes)."
    )


def front(grid: Grid, condition: str) -> list[Cell]:
    """Return the Pareto front under a condition: cells that no other beats in success and latency.

    A cell is a run of one ego agent with one helper agent, each a model with a prompt version and
    an answer mode. The condition is the name of a set of settings of radio, asking and fusion. The
    cells are sorted by latency, the fastest first.
    """

    def success(cell: Cell) -> float:
        return grid.success(cell, condition).value

    def order(cell: Cell) -> tuple[float, float]:
        return cell.estimate(LATENCY, condition).value, -success(cell)

    best: list[Cell] = []
    for cell in sorted(grid.cells, key=order):
        if not best or success(cell) > success(best[-1]):
            best.append(cell)
    return best


def pair(grid: Grid, cell: Cell) -> str:
    """Return a cell's name, such as `model-a + model-b`: its ego's and its helpers' agent.

    A cell is a run of one ego agent with one helper agent, each a model with a prompt version and
    an answer mode. Both are named by what varies in the grid, or by their model.
    """
    return f"{grid.name(cell.ego, 'ego')} + {grid.name(cell.helper, 'helper')}"


def _cells(grid: Grid, condition: str, out: Path, terminal: bool) -> Table:
    best = {cell.run.path for cell in front(grid, condition)}
    place, rows = beside(out / "index.html"), []
    for cell in sorted(grid.cells, key=lambda cell: -grid.success(cell, condition).value):
        success = interval_of(grid.success(cell, condition))
        latency = f"{cell.estimate(LATENCY, condition).value:.1f}{' ◆' * (cell.run.path in best)}"
        tokens_of_decision = PLAIN.number(cell.estimate("tokens", condition).value)
        agents = f"{cell.ego.name} + {cell.helper.name}"
        run = linked(f"cells/{cell.run.path.name}", place(cell.run))
        rows.append((pair(grid, cell), success, latency, tokens_of_decision, agents, run))
    heads = (
        "ego + helpers",
        f"{grid.success_rule.words} %, 95 % CI",
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
    effects = [effect for effect in grid.effects if effect.condition == condition]
    effects = [effect for effect in effects if not np.isnan(effect.estimate.value)]
    effects.sort(key=lambda effect: -abs(effect.estimate.value))
    rows = [(effect.what, interval_of(effect.estimate), p_cell(effect.p)) for effect in effects]
    return Table(
        f"Effect of each choice, {condition}",
        ("effect", "points, 95 % CI", "p"),
        rows,
        f"An effect is the difference in {grid.success_rule.words} when one factor changes, "
        "averaged over all other factors. An interaction (×) is half the difference between the "
        "effects of one factor at two levels of the other. p comes from the interval and is "
        f"corrected by Holm's method for all {len(grid.effects)} effects; bold: 0.05 or less.",
        terminal=range(3) if terminal else (),
        most=MOST_EFFECTS,
    )


def tables(grid: Grid) -> "dict[str, pd.DataFrame]":
    """Return the data frames `cells` and `effects`, by these names, to write as files.

    A cell is a run of one ego's model with one helpers' model. `cells` has a row for each cell,
    condition (settings of radio, asking and fusion) and metric; `effects` a row for each change of
    what the grid varies, such as the ego's prompt. Each row has an estimate and the ends of its 95
    % interval.
    """
    import pandas as pd

    def row(cell: Cell, condition: str, metric: str, estimate: Estimate) -> dict[str, Any]:
        levels = {f"{half}_{field}": cell.level(half, field) for half, field in factors}
        place = {"run": cell.run.path.name, "condition": condition, "metric": metric}
        return {**levels, **place, **ends(estimate)}

    factors = list(product(HALVES, FIELDS))
    places = list(product(grid.cells, grid.conditions))
    cells = list[dict[str, Any]]()
    for cell, condition in places:
        for metric in cell.values:
            cells.append(row(cell, condition, metric, cell.estimate(metric, condition)))
    headline_metric = grid.success_rule.metric
    if headline_metric != SUCCESS:
        for cell, condition in places:
            success = grid.success(cell, condition)
            cells.append(row(cell, condition, headline_metric, success))
    effects = []
    for effect in grid.effects:
        values = {"condition": effect.condition, "effect": effect.what, **ends(effect.estimate)}
        effects.append({**values, "p_holm": effect.p})
    return {"cells": pd.DataFrame(cells), "effects": pd.DataFrame(effects)}
