"""Tables, examples and pictures of the page, besides its charts, matrix and decisions."""

from typing import Any

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
    """Return how much was run, of what: said once for all numbers."""
    episodes, seeds = (
        " or ".join(map(str, sorted({len(numbers) for numbers in each})))
        for each in (
            [run.grid.episodes for run in runs.runs],
            [run.grid.seeds for run in runs.runs],
        )
    )
    source = runs.runs[0].source
    return f"{episodes} episodes × {seeds} channel seeds of {source}; 95 % intervals over episodes"


def summary(run: Run) -> list[dict[str, Any]]:
    """Return a run's summary: a metric a line, with its value in each condition."""
    return [
        {
            "name": entry(metric).label,
            "meaning": entry(metric).meaning,
            "cells": [
                (s := run.score(condition, metric)) and words.shown(s)
                for condition in run.conditions
            ],
        }
        for metric in dict.fromkeys(s.metric for s in run.scores if s.condition != "all")
        if not entry(metric).superseded
    ]


def probabilities(runs: Runs) -> list[dict[str, Any]]:
    """Return how honest the probabilities of each run's policies are:
    a condition a line, where known.
    """
    lines = []
    for name, run in zip(runs.names, runs.runs, strict=True):
        flips = run.score("all", "flip_rate_ego")
        judged = run.decisions.of_actions("safe").max(axis=-1) == 1.0
        places = run.decisions.codes("condition", run.conditions)
        one_optimal = judged_of(run.grid, run.decisions, run.grid.places(run.decisions))
        for place, condition in enumerate(run.conditions):
            scores, sure = (
                [run.score(condition, metric) for metric in some] for some in (HONEST, SURE)
            )
            if any(scores):
                n, n_one = int(judged[places == place].sum()), len(one_optimal[place].sure)
                groups = [{"n": n, "scores": [*scores, flips]}, {"n": n_one, "scores": sure}]
                lines.append({"run": name, "condition": condition, "groups": groups})
    return lines


def answers(runs: Runs) -> list[tuple[str, list[Any]]]:
    """Return what does not depend on the condition: a metric a line, with its value in each run."""
    names = dict.fromkeys(s.metric for run in runs.runs for s in run.scores if s.condition == "all")
    return [
        (entry(m).label, [(s := run.score("all", m)) and words.shown(s) for run in runs.runs])
        for m in names
    ]


def examples(runs: Runs) -> list[dict[str, Any]]:
    """Return the first answers of each status but strict, and where each stands."""
    by_status: dict[str, list[dict[str, Any]]] = {}
    for n, run in enumerate(runs.runs):
        for answer in run.answers:
            if answer.status != "strict":
                by_status.setdefault(answer.status, []).append({"run": n, "answer": answer})
    return [{"status": status, "answers": every[:EXAMPLES]} for status, every in by_status.items()]


def sweeps(run: Run) -> list[dict[str, str]]:
    """Return pictures of the sweeps that lie in the run's folder;
    none that a link leads out of it to.
    """
    here = run.path.resolve()
    return [
        {
            "name": f"{manifest.parent.name}: {svg.stem}",
            "src": picture(on_dark_too(bytes_of(svg, "picture"))),
        }
        for manifest in sorted(run.path.glob("*/sweep.json"))
        for svg in sorted(manifest.parent.glob("*.svg"))
        if svg.is_file() and svg.resolve().is_relative_to(here)
    ]
