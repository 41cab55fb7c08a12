"""Prompts and models side by side: what each run scored, and which cannot be told from the best."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from statistics import median
from types import MappingProxyType

import numpy as np

from harness.core.arrays import Floats
from harness.core.figures import some_of
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate, cluster_numbers, joined_clusters
from harness.report.runs import Runs
from harness.report.words import score_texts
from harness.runs.folder import Run
from harness.runs.headline import BALANCED, IN_WORDS, SUCCESS, headline_of
from harness.runs.metric_names import LATENCY
from harness.runs.metrics import entry
from harness.runs.records import Score
from harness.runs.success import Success

Successes = Mapping[tuple[int, int], float]  # 0 or 1, by episode and seed

HEADLINE_METRICS = (BALANCED, *entry(BALANCED).halves)
OPTIMAL = "optimal_action_rate"
BEST, CLOSE, WORSE = "best", "not told from the best", "worse"


@dataclass(frozen=True)
class Behind:
    """Hold how far one run's success is behind the best run's, over the episodes that both have.

    `change` is its success minus that of the best, with a 95 % interval; `p_value` is of no
    difference, corrected by Holm's method. Success is balanced (mean of that with a danger and
    without) if all runs have that, else plain. A danger is a vehicle that would meet an ego which
    keeps its speed.
    """

    # its success minus the best one's, by the headline metric, with a 95 % interval
    change: Estimate
    # of no difference, by that interval, corrected by Holm's method for all pairs of runs
    p_value: float

    @property
    def undecided(self) -> bool:
        return self.p_value > LEVEL


Mark = tuple[str, Behind | None]  # of a run under a condition: the mark, and how it stands


@dataclass(frozen=True)
class Line:
    """Hold the results of one run under one condition: a row of the report's main table.

    `name` is the run's, and `condition` that of the condition, a set of settings of the radio, of
    asking helpers and of fusing their messages. `scores` has the run's scores by metric, None where
    unknown. `mark` says whether it is the best run, not told from it, or worse, and `behind` how
    far it is behind, None for the best. `headline` is the metric by which runs are read, balanced
    or plain success, and `tokens` the median numbers of prompt and answer tokens.
    """

    name: str  # the run's name on the page
    model: str  # name of its model
    prompt: str  # its prompt version
    answer: str  # its answer mode, such as `json`
    condition: str  # name of the condition
    # the run's value of each metric with its interval, by the metric's name; None where it has none
    scores: Mapping[str, Score | None]
    # medians of a prompt and an answer; None where not counted
    tokens: tuple[float | None, float | None]
    # `BEST` for the best run under its condition, `CLOSE` for one that cannot be told from it,
    # `WORSE`; empty where no run is the best
    mark: str
    behind: Behind | None  # how it stands to the best; None for the best
    # name of the metric by which the runs are compared: balanced success, or plain where one lacks
    # that
    headline: str

    @property
    def success(self) -> Score | None:
        """Return the run's success under this condition, with its interval; None where unknown.

        It is balanced success if all runs of the page have it, else plain.
        """
        return self.scores[self.headline]


@dataclass(frozen=True)
class Grid:
    """Hold success under one condition as a table, prompts across and models down.

    `condition` is the condition's name, a named set of settings of the radio, of asking helpers and
    of fusing their messages. `prompts` are the heads of the columns. Each of `rows` is a model's
    name and, for each prompt, the results of the runs with both: several if it was run again.
    """

    condition: str  # the condition's name
    # heads of the columns: prompt version, and the answer mode where runs differ in it
    prompts: tuple[str, ...]
    # a model, and what was run with each of these prompts: several if it was run again
    rows: tuple[tuple[str, tuple[tuple[Line, ...], ...]], ...]


METRICS = (
    *HEADLINE_METRICS,
    SUCCESS,
    "strict_rate",
    "recovered_rate",
    "failed_rate",
    LATENCY,
    "latency_p95_ms",
    OPTIMAL,
    "optimal_brier",
)


def lines(runs: Runs) -> list[Line]:
    """Return a row for each run and condition, by condition, then in the runs' order.

    A row has the run's scores, and how it stands to the best run under the condition. A condition
    is a named set of settings of the radio, of asking helpers and of fusing their messages.
    """
    lengths = [_tokens(run) for run in runs.runs]
    headline_metric = headline_of(*runs.runs)
    all_marks = _marks(runs, headline_metric)
    rows = []
    for condition in runs.conditions:
        for n, run in enumerate(runs.runs):
            if condition not in run.conditions:
                continue
            variant = run.manifest.variant
            mark, behind = all_marks[condition][n]
            line = Line(
                name=runs.names[n],
                model=f"{variant.model}{variant.mix}",
                prompt=variant.prompt,
                answer=variant.answer,
                condition=condition,
                scores={metric: _score(run, condition, metric) for metric in METRICS},
                tokens=lengths[n],
                mark=mark,
                behind=behind,
                headline=headline_metric,
            )
            rows.append(line)
    return rows


def _marks(runs: Runs, headline_metric: str) -> dict[str, list[Mark]]:
    """Return by condition the mark of each run, in the runs' order."""
    by_run = [_successes(run) if len(runs.runs) > 1 else {} for run in runs.runs]
    by_condition = []
    for condition in runs.conditions:
        by_condition.append([successes.get(condition, {}) for successes in by_run])
    dangerous = set[int]()
    episodes = [episode for run in runs.runs for episode in run.episodes]
    if headline_metric == BALANCED:
        dangerous = {each.episode for each in episodes if each.danger != "none"}
    marks = marked(by_condition, dangerous, _clusters(runs))
    return dict(zip(runs.conditions, marks, strict=True))


def _clusters(runs: Runs) -> dict[int, str]:
    """Return the cluster of each episode of the runs; two are in one if any run says so."""
    numbers = sorted({number for run in runs.runs for number in run.grid.episodes})
    partitions = []
    for run in runs.runs:
        cluster_of = {each.episode: each.cluster for each in run.episodes}
        partitions.append([cluster_of.get(number) for number in numbers])
    clusters = joined_clusters(partitions)
    names = [] if clusters is None else [str(cluster) for cluster in clusters.tolist()]
    return dict(zip(numbers, names, strict=False))


def grids(results: Sequence[Line]) -> list[Grid]:
    """Return a table of models by prompts for each condition of these rows.

    Each of `results` is a run's scores under a condition. A condition is a named set of settings of
    the radio, of asking helpers and of fusing their messages.
    """
    modes = {line.answer for line in results}
    cells_of: dict[str, dict[tuple[str, str], list[Line]]] = {}  # by condition, model and prompt
    for line in results:
        prompt = line.prompt if len(modes) == 1 else f"{line.prompt} · {line.answer}"
        cells_of.setdefault(line.condition, {}).setdefault((line.model, prompt), []).append(line)
    grids = []
    for condition, cells in cells_of.items():
        models = dict.fromkeys(model for model, _ in cells)
        prompts = tuple(dict.fromkeys(prompt for _, prompt in cells))
        rows = []
        for model in models:
            row = tuple(tuple(cells.get((model, prompt), ())) for prompt in prompts)
            rows.append((model, row))
        grids.append(Grid(condition, prompts, tuple(rows)))
    return grids


def _score(run: Run, condition: str, metric: str) -> Score | None:
    """Return a condition's score; for answers the ego's, which are the same under all."""
    return run.score(condition, metric) or run.score("all", f"{metric}_ego")


def _tokens(run: Run) -> tuple[float | None, float | None]:
    """Return the median tokens of a prompt and of an answer; None where nobody counted them."""
    prompts = [a.prompt_tokens for a in run.answers if a.prompt_tokens is not None]
    answers = [a.completion_tokens for a in run.answers if a.completion_tokens is not None]
    prompt_tokens = float(median(prompts)) if prompts else None
    answer_tokens = float(median(answers)) if answers else None
    return prompt_tokens, answer_tokens


def _successes(run: Run) -> dict[str, dict[tuple[int, int], float]]:
    """Return success by condition and, in each, by episode and seed."""
    by_condition: dict[str, dict[tuple[int, int], float]] = {name: {} for name in run.conditions}
    for episode in run.episodes:
        by_condition[episode.condition][episode.episode, episode.seed] = float(episode.success)
    return by_condition


def marked(
    conditions: Sequence[Sequence[Successes]],
    dangerous: Container[int] = (),
    cluster_of: Mapping[int, str | None] = MappingProxyType({}),
) -> list[list[Mark]]:
    """Return for each condition the marks of all runs: best, not told from the best, or worse.

    A mark comes with the comparison with the best run, or None for the best itself; p-values are
    corrected by Holm's method for all pairs of runs. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.

    Args:
        conditions: for each condition the success (0 or 1) of each run, by episode's number and
            channel seed; empty for a run that was not made under it.
        dangerous: numbers of the episodes with a danger, if balanced success is compared.
        cluster_of: what the layouts of episodes are cut from, by their numbers.
    """
    results = [_behind_best(successes, dangerous, cluster_of) for successes in conditions]
    p_values = [each.p_value for _, behind in results for each in behind.values()]
    pairs = 0  # of runs under the same condition
    for successes in conditions:
        pairs += comb(sum(bool(of_run) for of_run in successes), 2)
    corrected = iter(holm(p_values, pairs))
    marks = []
    for successes, (best, behind) in zip(conditions, results, strict=True):
        marks_of_runs: list[Mark] = [("", None)] * len(successes)
        for run, standing in behind.items():
            standing = replace(standing, p_value=next(corrected))
            marks_of_runs[run] = (CLOSE if standing.undecided else WORSE, standing)
        if best is not None:
            marks_of_runs[best] = (BEST, None)
        marks.append(marks_of_runs)
    return marks


def _behind_best(
    ended: Sequence[Successes], dangerous: Container[int], cluster_of: Mapping[int, str | None]
) -> tuple[int | None, dict[int, Behind]]:
    """Return the best run and the others against it, p not yet corrected;
    None where there is no such run.

    The best is not behind any other on the episodes and seeds that the two share:
    a run of other episodes is no better for their being easy.
    """
    runs = [n for n, successes in enumerate(ended) if successes]
    for best in runs:
        pairs = {}
        for n in runs:
            if n != best:
                pairs[n] = _shared(ended[n], ended[best], dangerous, cluster_of)
        if pairs and all(a.size and rule.mean(a) <= rule.mean(b) for rule, a, b in pairs.values()):
            return best, {n: _behind(*pair) for n, pair in pairs.items()}
    return None, {}


def _shared(
    first: Successes,
    second: Successes,
    dangerous: Container[int],
    cluster_of: Mapping[int, str | None],
) -> tuple[Success, Floats, Floats]:
    """Return the success rule of the episodes that both runs have, and the successes of each
    run in them, (S, E); (0, 0) where they share none.
    """
    keys = sorted(first.keys() & second.keys())
    episodes = sorted({episode for episode, _ in keys})
    clusters = cluster_numbers([cluster_of.get(episode) for episode in episodes])
    is_dangerous = np.array([episode in dangerous for episode in episodes], dtype=bool)
    rule = Success(is_dangerous, clusters)
    if not keys:
        return rule, np.empty((0, 0)), np.empty((0, 0))
    a = np.array([first[key] for key in keys]).reshape(len(episodes), -1).T
    b = np.array([second[key] for key in keys]).reshape(len(episodes), -1).T
    return rule, a, b


def _behind(rule: Success, a: Floats, b: Floats) -> Behind:
    p = rule.p_value(a, b)
    # One episode has no interval: nothing says that it is more than chance.
    return Behind(rule.difference(a, b), 1.0 if p is None else p)


def uneven(runs: Runs) -> str | None:
    """Return a sentence on runs with different numbers of episodes or seeds; None if alike."""
    if len({(run.grid.episodes, run.grid.seeds) for run in runs.runs}) < 2:
        return None
    each = "; ".join(
        f"{name}: {len(run.grid.episodes)} × {len(run.grid.seeds)}"
        for name, run in zip(runs.names, runs.runs, strict=True)
    )
    return (
        f"The runs have different episodes × seeds ({each}): a success rate is over the run's own, "
        "and two runs are compared on those that both have."
    )


def figures(results: Sequence[Line]) -> list[dict[str, str]]:
    """Return the best run's success under each condition as key figures for a page's top.

    An entry has texts at `what`, `value`, `interval` and `n`. Each of `results` is a run's scores
    under a condition, a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    rows = []
    for line in results:
        if line.mark == BEST and line.success:
            name = f"{IN_WORDS[line.headline]} with {line.condition}, {_rank(line, results)}"
            rows.append({"what": name, **score_texts(line.success)})
    return rows


def _rank(best: Line, results: Sequence[Line]) -> str:
    """Name the best run of a condition, unless others cannot be told from it."""
    close = _close(best.condition, results)
    if close:
        return f"the most of {len(close) + 1} runs that cannot be told apart"
    return f"best: {best.name}"


def shared(results: Sequence[Line]) -> set[str]:
    """Return the names of the conditions under which some run cannot be told from the best one.

    Each of `results` is a run's scores under a condition. A condition is a named set of settings of
    the radio, of asking helpers and of fusing their messages.
    """
    return {line.condition for line in results if line.mark == CLOSE}


def _close(condition: str, results: Sequence[Line]) -> list[str]:
    return [line.name for line in results if line.condition == condition and line.mark == CLOSE]


def headline(results: Sequence[Line]) -> str:
    """Return a sentence on the run with the highest success under each condition.

    Success is balanced where all runs have that. Runs that cannot be told from the best are named,
    too. Each of `results` is a run's scores under a condition. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    outcomes = []
    for condition in dict.fromkeys(line.condition for line in results):
        lines = [line for line in results if line.condition == condition]
        best = next((line for line in lines if line.mark == BEST), None)
        if best is not None and best.success:
            rate = score_texts(best.success)["value"]
            close = _close(condition, results)
            if close:
                names = some_of([best.name, *close])
                outcome = f"none clearly ({rate} at the most; {names} cannot be told apart)"
            else:
                outcome = f"{best.name} {rate}"
            outcomes.append(f"{condition}: {outcome}")
        elif len(lines) > 1:
            outcome = "no run, since each is behind another or shares no episodes with it"
            outcomes.append(f"{condition}: {outcome}")
    if not outcomes:
        return "No two runs have a condition in common."
    measure = " by balanced success" if results[0].headline == BALANCED else ""
    return f"Best{measure} under {'; '.join(outcomes)}."
