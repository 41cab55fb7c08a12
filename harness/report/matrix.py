"""Prompts and models side by side: what each run scored, and which cannot be told from the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from harness.core.paired import SuccessTest, success_test
from harness.report.runs import Runs
from harness.report.words import success_of
from harness.runs.folder import Run
from harness.runs.metrics import LATENCY, SUCCESS
from harness.runs.records import Score

P_VALUE = 0.05
BEST, CLOSE, WORSE = "best", "not told from the best", "worse"


@dataclass(frozen=True)
class Behind:
    """A run against the best one, over the episodes that both have.

    Attributes:
        difference: its success minus the best one's.
        episodes: how many both have.
        test: what says whether that is chance.
    """

    difference: float
    episodes: int
    test: SuccessTest

    @property
    def undecided(self) -> bool:
        """Whether the two cannot be told apart."""
        if self.test.p_value is not None:
            return self.test.p_value > P_VALUE
        return self.test.low is None or self.test.high is None or self.test.low <= 0.0 <= self.test.high


@dataclass(frozen=True)
class Line:
    """One run under one condition.

    Attributes:
        name: of the run.
        model: of its card.
        prompt: version.
        answer: answer mode.
        condition: operating point.
        scores: metrics by name; None where the run has none.
        tokens: median tokens of a prompt and of an answer; None where the engine counts none.
        mark: `BEST` success under its condition, `CLOSE` or `WORSE`; empty where runs cannot be paired.
        behind: how it stands to the best; None for the best.
    """

    name: str
    model: str
    prompt: str
    answer: str
    condition: str
    scores: Mapping[str, Score | None]
    tokens: tuple[float | None, float | None]
    mark: str
    behind: Behind | None


@dataclass(frozen=True)
class Grid:
    """Success under one condition, prompts across and models down.

    Attributes:
        condition: operating point.
        prompts: heads of the columns: version, and the answer mode where runs differ in it.
        rows: a model, and what was run with each of these prompts: several if it was run again.
    """

    condition: str
    prompts: tuple[str, ...]
    rows: tuple[tuple[str, tuple[tuple[Line, ...], ...]], ...]


METRICS = (
    SUCCESS, "strict_rate", "recovered_rate", "failed_rate", LATENCY, "latency_p95_ms", "brier",
)  # fmt: skip


def lines(runs: Runs) -> list[Line]:
    """Every run under each of its conditions, by condition and then in the runs' order."""
    ended = [_successes(run) if len(runs.runs) > 1 else {} for run in runs.runs]
    lengths = [_tokens(run) for run in runs.runs]
    rows = []
    for condition in runs.conditions:
        marks = _marks([of.get(condition) for of in ended])
        for n, run in enumerate(runs.runs):
            if condition in run.conditions:
                scores = {metric: _score(run, condition, metric) for metric in METRICS}
                who = run.manifest.variant
                of_line = runs.names[n], who.model, who.prompt, who.answer, condition
                rows.append(Line(*of_line, scores, lengths[n], *marks[n]))
    return rows


def grids(found: Sequence[Line]) -> list[Grid]:
    """The lines as a table a condition, with the models and prompts that were run under it."""
    modes = {line.answer for line in found}
    tables: dict[str, dict[tuple[str, str], list[Line]]] = {}
    for line in found:
        asked = line.prompt if len(modes) == 1 else f"{line.prompt} · {line.answer}"
        tables.setdefault(line.condition, {}).setdefault((line.model, asked), []).append(line)
    grids = []
    for condition, cells in tables.items():
        models, prompts = (tuple(dict.fromkeys(key[place] for key in cells)) for place in (0, 1))
        rows = tuple(
            (model, tuple(tuple(cells.get((model, prompt), ())) for prompt in prompts)) for model in models
        )
        grids.append(Grid(condition, prompts, rows))
    return grids


def _score(run: Run, condition: str, metric: str) -> Score | None:
    """A condition's; for answers the ego's, which are the same under all."""
    return run.score(condition, metric) or run.score("all", f"{metric}_ego")


def _tokens(run: Run) -> tuple[float | None, float | None]:
    counts = [
        [count for a in run.answers if (count := getattr(a, key)) is not None]
        for key in ("prompt_tokens", "completion_tokens")
    ]
    sent, answered = (float(median(of)) if of else None for of in counts)
    return sent, answered


def _successes(run: Run) -> dict[str, dict[tuple[int, int], float]]:
    """Success, 0 or 1, by condition and, in each, by episode and seed."""
    by_condition: dict[str, dict[tuple[int, int], float]] = {name: {} for name in run.conditions}
    for episode in run.episodes:
        by_condition[episode.condition][episode.episode, episode.seed] = float(episode.success)
    return by_condition


def _marks(ended: Sequence[Mapping[tuple[int, int], float] | None]) -> list[tuple[str, Behind | None]]:
    """What each run is against the best, paired by episode; nothing where there is only one."""
    scored = [n for n, of in enumerate(ended) if of]
    if len(scored) < 2:
        return [("", None)] * len(ended)
    best = max(scored, key=lambda n: np.mean(list((ended[n] or {}).values())))
    marks: list[tuple[str, Behind | None]] = []
    for n, of in enumerate(ended):
        behind = None if n == best else _behind(of or {}, ended[best] or {})
        mark = "" if behind is None else CLOSE if behind.undecided else WORSE
        marks.append((BEST if n == best else mark, behind))
    return marks


def _behind(one: Mapping[tuple[int, int], float], best: Mapping[tuple[int, int], float]) -> Behind | None:
    both = sorted(one.keys() & best.keys())
    episodes, seeds = ({key[place] for key in both} for place in (0, 1))
    if len(both) != len(episodes) * len(seeds) or not both:
        return None
    a, b = (np.array([of[key] for key in both]).reshape(len(episodes), -1) for of in (one, best))
    test = success_test(b, a)
    return None if test is None else Behind(float((a - b).mean()), len(episodes), test)


def headline(found: Sequence[Line]) -> str:
    """What came out of several runs: under each condition the best, and which cannot be told from it."""
    best = []
    for line in found:
        success = line.scores[SUCCESS]
        if line.mark == BEST and success:
            close = [o.name for o in found if o.condition == line.condition and o.mark == CLOSE]
            rest = f", not told apart from {', '.join(close)}" if close else ""
            best.append(f"{line.condition}: {line.name} {success_of(success)}{rest}")
    return (
        f"Best under {'; '.join(best)}."
        if best
        else "The runs share no episodes, so none is called the best."
    )
