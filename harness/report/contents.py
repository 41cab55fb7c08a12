"""Tables, examples and pictures of the page, besides its charts, matrix and decisions."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from harness.core.files import bytes_of
from harness.report import words
from harness.report.library import on_dark_too, picture
from harness.report.runs import Runs
from harness.runs.folder import Run
from harness.runs.metrics import entry
from harness.runs.summary import judged_of

HONEST = ("optimal_action_rate", "optimal_brier", "optimal_nll_nats")
SURE = ("calibration_error_one_optimal", "coverage_at_5_risk_one_optimal")
EXAMPLES = 3  # of each status of answers


def size(runs: Runs) -> str:
    """Return a phrase on how many episodes and channel seeds runs have, and on which dataset.

    A channel seed is the seed of the radio channel's random draws. Of a single run it says who was
    asked how much as well.
    """
    episodes = _either(len(run.grid.episodes) for run in runs.runs)
    seeds = _either(len(run.grid.seeds) for run in runs.runs)
    source = runs.runs[0].source
    text = f"{episodes} episodes × {seeds} channel seeds of {source}; 95 % intervals over episodes"
    return f"{text}; {words.questions(runs.runs[0])}" if len(runs.runs) == 1 else text


def _either(counts: Iterable[int]) -> str:
    """Return the different counts in words, the least first: `40 or 50`."""
    return " or ".join(map(str, sorted(set(counts))))


def summary(run: Run) -> list[dict[str, Any]]:
    """Return the rows of a run's table of metrics, for its page.

    A row has `name`, `meaning`, and `cells` by condition. A cell has `value`, `interval` and `n` as
    text; None where the metric has no value there. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    metrics = dict.fromkeys(score.metric for score in run.scores if score.condition != "all")
    rows: list[dict[str, Any]] = []
    for metric in map(entry, metrics):
        if not metric.superseded:
            cells = [_cell(run, condition, metric.name) for condition in run.conditions]
            rows.append({"name": metric.label, "meaning": metric.meaning, "cells": cells})
    return rows


def _cell(run: Run, condition: str, metric: str) -> dict[str, str] | None:
    score = run.score(condition, metric)
    return None if score is None else words.score_texts(score)


def probabilities(runs: Runs) -> list[dict[str, Any]]:
    """Return a row for each run and condition with scores of the probabilities of its decisions.

    A row has `run` and `condition` by name, and `groups`: two sets of decisions, each with `n`, how
    many, and `scores`. These are the decisions where some action is safe (leaves success possible),
    and those with exactly one such action. A condition is a named set of settings of the radio, of
    asking helpers and of fusing their messages.
    """
    lines = []
    for name, run in zip(runs.names, runs.runs, strict=True):
        flips = run.score("all", "flip_rate_ego")
        n_judged = np.zeros(len(run.conditions), dtype=int)
        for d in run.decisions.pieces():
            judged = d.of_actions("safe").max(axis=-1) == 1.0
            places = d.codes("condition", run.conditions)
            n_judged += np.bincount(places[judged], minlength=len(n_judged))
        one_optimal = judged_of(run.grid, run.decisions, run.grid.places(run.decisions))
        for place, condition in enumerate(run.conditions):
            scores = [run.score(condition, metric) for metric in HONEST]
            if not any(scores):
                continue
            of_judged = {"n": int(n_judged[place]), "scores": [*scores, flips]}
            scores_of_one = [run.score(condition, metric) for metric in SURE]
            of_one_optimal = {"n": len(one_optimal[place].sure), "scores": scores_of_one}
            groups = [of_judged, of_one_optimal]
            lines.append({"run": name, "condition": condition, "groups": groups})
    return lines


def answers(runs: Runs) -> list[tuple[str, list[Any]]]:
    """Return the rows of the table of metrics on answers, which are the same under every condition.

    A row is a metric's label and one cell for each run; None where the run has no value. A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    scores = [score for run in runs.runs for score in run.scores]
    metrics = dict.fromkeys(score.metric for score in scores if score.condition == "all")
    rows = []
    for metric in metrics:
        cells = [_cell(run, "all", metric) for run in runs.runs]
        rows.append((entry(metric).label, cells))
    return rows


def examples(runs: Runs) -> list[dict[str, Any]]:
    """Return examples of answers that were not perfect: the first of each parse status.

    Up to `EXAMPLES` of each status but `strict` are taken, over all runs. An entry has `status`,
    such as `bad_sum`, and `answers`; each of these has the index of its `run` and the `answer`'s
    record.
    """
    by_status: dict[str, list[dict[str, Any]]] = {}
    for place, run in enumerate(runs.runs):
        for answer in run.answers:
            if answer.status != "strict":
                by_status.setdefault(answer.status, []).append({"run": place, "answer": answer})
    return [
        {"status": status, "answers": answers[:EXAMPLES]} for status, answers in by_status.items()
    ]


def sweeps(run: Run) -> list[dict[str, str]]:
    """Return the charts of the sweeps in a run's folder: `name`, and `src`, the SVG as a data URI.

    A sweep scores the run's stored answers once more under other settings, such as packet losses. A
    link that leads out of the folder is not followed.
    """
    folder = run.path.resolve()
    manifests = sorted(run.path.glob("*/sweep.json"))
    files = [file for manifest in manifests for file in sorted(manifest.parent.glob("*.svg"))]
    pictures = []
    for file in files:
        if file.is_file() and file.resolve().is_relative_to(folder):
            address = picture(on_dark_too(bytes_of(file, "picture")))
            pictures.append({"name": f"{file.parent.name}: {file.stem}", "src": address})
    return pictures
