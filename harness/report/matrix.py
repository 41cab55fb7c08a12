"""Prompts and models side by side: what each run scored, and which cannot be told from the best."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import median

import numpy as np

from harness.core.arrays import Floats
from harness.core.figures import some_of
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate
from harness.report.runs import Runs
from harness.report.words import shown
from harness.runs.folder import Run
from harness.runs.leading import IN_WORDS, lead_of
from harness.runs.metrics import BALANCED, LATENCY, SUCCESS, entry
from harness.runs.records import Score
from harness.runs.success import Success

Successes = Mapping[tuple[int, int], float]  # 0 or 1, by episode and seed

LEADING = (BALANCED, *entry(BALANCED).halves)
OPTIMAL = "optimal_action_rate"
BEST, CLOSE, WORSE = "best", "not told from the best", "worse"


@dataclass(frozen=True)
class Behind:
    """A run against the best one, over the episodes that both have."""

    # of its success minus the best one's, as it leads, with a 95 % interval over these
    change: Estimate
    # of no difference, by that interval, corrected by Holm's method for all pairs of runs
    p_value: float

    @property
    def undecided(self) -> bool:
        return self.p_value > LEVEL


@dataclass(frozen=True)
class Line:
    """One run under one condition."""

    name: str  # of the run
    model: str  # of its card
    prompt: str  # version
    answer: str  # answer mode
    condition: str  # operating point
    scores: Mapping[str, Score | None]  # metrics by name; None where the run has none
    # medians of a prompt and an answer; None where not counted
    tokens: tuple[float | None, float | None]
    mark: str  # `BEST` under its condition, `CLOSE` or `WORSE`; empty where no run is the best
    behind: Behind | None  # how it stands to the best; None for the best
    lead: str  # the metric by which the runs are read together

    @property
    def success(self) -> Score | None:
        """What leads."""
        return self.scores[self.lead]


@dataclass(frozen=True)
class Grid:
    """Success under one condition, prompts across and models down."""

    condition: str  # operating point
    # heads of the columns: version, and the answer mode where runs differ in it
    prompts: tuple[str, ...]
    # a model, and what was run with each of these prompts: several if it was run again
    rows: tuple[tuple[str, tuple[tuple[Line, ...], ...]], ...]


METRICS = (
    *LEADING,
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
    """Return every run under each of its conditions, by condition and then in the runs' order."""
    ended = [_successes(run) if len(runs.runs) > 1 else {} for run in runs.runs]
    lengths = [_tokens(run) for run in runs.runs]
    lead = lead_of(*runs.runs)
    dangerous = {e.episode for run in runs.runs for e in run.episodes if e.danger != "none"}
    by_condition = [[of.get(condition, {}) for of in ended] for condition in runs.conditions]
    all_marks = marked(by_condition, dangerous if lead == BALANCED else ())
    rows = []
    for condition, marks in zip(runs.conditions, all_marks, strict=True):
        for n, run in enumerate(runs.runs):
            if condition in run.conditions:
                scores = {metric: _score(run, condition, metric) for metric in METRICS}
                who = run.manifest.variant
                of_line = runs.names[n], f"{who.model}{who.mix}", who.prompt, who.answer, condition
                rows.append(Line(*of_line, scores, lengths[n], *marks[n], lead))
    return rows


def grids(results: Sequence[Line]) -> list[Grid]:
    """Return the lines as a table a condition,
    with the models and prompts that were run under it.
    """
    modes = {line.answer for line in results}
    tables: dict[str, dict[tuple[str, str], list[Line]]] = {}
    for line in results:
        asked = line.prompt if len(modes) == 1 else f"{line.prompt} · {line.answer}"
        tables.setdefault(line.condition, {}).setdefault((line.model, asked), []).append(line)
    grids = []
    for condition, cells in tables.items():
        models, prompts = (tuple(dict.fromkeys(key[place] for key in cells)) for place in (0, 1))
        rows = tuple(
            (model, tuple(tuple(cells.get((model, prompt), ())) for prompt in prompts))
            for model in models
        )
        grids.append(Grid(condition, prompts, rows))
    return grids


def _score(run: Run, condition: str, metric: str) -> Score | None:
    """Return a condition's score; for answers the ego's, which are the same under all."""
    return run.score(condition, metric) or run.score("all", f"{metric}_ego")


def _tokens(run: Run) -> tuple[float | None, float | None]:
    counts = [(a.prompt_tokens, a.completion_tokens) for a in run.answers]
    stated = ([count for count in of if count is not None] for of in zip(*counts, strict=True))
    sent, answered = (
        (float(median(of)) if of else None for of in stated) if counts else (None, None)
    )
    return sent, answered


def _successes(run: Run) -> dict[str, dict[tuple[int, int], float]]:
    """Return success by condition and, in each, by episode and seed."""
    by_condition: dict[str, dict[tuple[int, int], float]] = {name: {} for name in run.conditions}
    for episode in run.episodes:
        by_condition[episode.condition][episode.episode, episode.seed] = float(episode.success)
    return by_condition


def marked(
    conditions: Sequence[Sequence[Successes]], dangerous: Container[int] = ()
) -> list[list[tuple[str, Behind | None]]]:
    """Return the mark of each run under each condition, and how it stands to the best one there.

    Args:
        conditions: of each, the successes of every run; empty for one that was not made under it.
        dangerous: the episodes with a danger, where balanced success leads.
    """
    results = [_behind_best(ended, dangerous) for ended in conditions]
    every = [(n, run) for n, (_, behind) in enumerate(results) for run in behind]
    p_values = [results[n][1][run].p_value for n, run in every]
    pairs = sum(len(list(combinations(filter(None, ended), 2))) for ended in conditions)
    corrected = dict(zip(every, holm(p_values, pairs), strict=True))
    marks: list[list[tuple[str, Behind | None]]] = []
    for n, (ended, (best, behind)) in enumerate(zip(conditions, results, strict=True)):
        of_runs: list[tuple[str, Behind | None]] = [("", None)] * len(ended)
        for run, standing in behind.items():
            standing = replace(standing, p_value=corrected[n, run])
            of_runs[run] = (CLOSE if standing.undecided else WORSE, standing)
        if best is not None:
            of_runs[best] = (BEST, None)
        marks.append(of_runs)
    return marks


def _behind_best(
    ended: Sequence[Successes], dangerous: Container[int]
) -> tuple[int | None, dict[int, Behind]]:
    """Return the best run and the others against it, p not yet corrected;
    None where there is no such run.

    The best is not behind any other on the episodes and seeds that the two share:
    a run of other episodes is no better for their being easy.
    """
    scored = [n for n, of in enumerate(ended) if of]
    for best in scored:
        pairs = {n: _shared(ended[n], ended[best], dangerous) for n in scored if n != best}
        if pairs and all(a.size and how.mean(a) <= how.mean(b) for how, a, b in pairs.values()):
            return best, {n: _behind(*pair) for n, pair in pairs.items()}
    return None, {}


def _shared(
    first: Successes, second: Successes, dangerous: Container[int]
) -> tuple[Success, Floats, Floats]:
    """Successes of the episodes and seeds that both have, each (S, E), and how they count."""
    both = sorted(first.keys() & second.keys())
    episodes = sorted({episode for episode, _ in both})
    a, b = (
        np.array([of[key] for key in both]).reshape(len(episodes), -1).T
        if both
        else np.empty((0, 0))
        for of in (first, second)
    )
    return Success(np.array([episode in dangerous for episode in episodes], dtype=bool)), a, b


def _behind(how: Success, a: Floats, b: Floats) -> Behind:
    p = how.p_value(a, b)
    # One episode has no interval: nothing says that it is more than chance.
    return Behind(how.difference(a, b), 1.0 if p is None else p)


def uneven(runs: Runs) -> str | None:
    """That the runs have not the same episodes and seeds, and which; None where they have."""
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
    """Return the best run's leading success under each condition,
    with what it is and its interval.
    """
    of_best = [(line, line.success) for line in results if line.mark == BEST]
    return [
        {
            "what": f"{IN_WORDS[line.lead]} with {line.condition}, {_rank(line, results)}",
            **shown(success),
        }
        for line, success in of_best
        if success
    ]


def _rank(best: Line, results: Sequence[Line]) -> str:
    """Name the best run of a condition, unless others cannot be told from it."""
    close = _close(best.condition, results)
    return (
        f"the most of {len(close) + 1} runs that cannot be told apart"
        if close
        else f"best: {best.name}"
    )


def shared(results: Sequence[Line]) -> set[str]:
    """Return the conditions in which some runs cannot be told from the one with the most."""
    return {line.condition for line in results if line.mark == CLOSE}


def _close(condition: str, results: Sequence[Line]) -> list[str]:
    return [line.name for line in results if line.condition == condition and line.mark == CLOSE]


def headline(results: Sequence[Line]) -> str:
    """Name the best of several runs under each condition,
    or those that cannot be told apart there.
    """
    outcomes = []
    for condition in dict.fromkeys(line.condition for line in results):
        of_condition = [line for line in results if line.condition == condition]
        best = next((line for line in of_condition if line.mark == BEST), None)
        if best is not None and (success := best.success):
            if close := _close(condition, results):
                apart = f"{some_of([best.name, *close])} cannot be told apart"
                outcomes.append(
                    f"{condition}: none clearly ({shown(success)['value']} at the most; {apart})"
                )
            else:
                outcomes.append(f"{condition}: {best.name} {shown(success)['value']}")
        elif len(of_condition) > 1:
            outcomes.append(
                f"{condition}: no run, since each is behind another or shares no episodes with it"
            )
    by = " by balanced success" if results[0].lead == BALANCED else ""
    return (
        f"Best{by} under {'; '.join(outcomes)}."
        if outcomes
        else "No two runs have a condition in common."
    )
