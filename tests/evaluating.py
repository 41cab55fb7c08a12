"""Evaluations as tests make them: the real parts, or the real parts around answers from a script."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.coordination.operating_point import POINTS
from harness.dataset.load import Dataset
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.live_world import LiveSource
from harness.evaluate.run import Evaluated, evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.runs.records import Score

FILES = ("answers.jsonl", "decisions.parquet", "episodes.csv", "summary.csv")


def spec_of(dataset: Dataset, model: str = "proxy", prompt: str = "v2", **options: Any) -> Spec:
    options = {"points": tuple(POINTS.values()), "seeds": (0, 1), **options}
    return Spec(cards.resolve(model), prompts.load(prompt), FrozenSource(dataset), **options)


def live_spec_of(model: str = "proxy", episodes: int = 2, first_seed: int = 0, **options: Any) -> Spec:
    options = {"points": tuple(POINTS.values()), "seeds": (0, 1), **options}
    return Spec(cards.resolve(model), prompts.load("v2"), LiveSource(first_seed, episodes), **options)


def run(spec: Spec, out: Path, resume: bool = False) -> Evaluated:
    return evaluate(spec, out, resume, lambda done: None)


def figure(done: Evaluated, condition: str, metric: str, interval: str = "episodes") -> Score:
    """The one row of a summary that says this."""
    wanted = (condition, metric, interval)
    [score] = [s for s in done.scores if (s.condition, s.metric, s.interval) == wanted]
    return score


class Scripted:
    """A backend that says what is written down for a request's id; else it is sure of IDLE."""

    def __init__(self, lines: Mapping[str, str | Completion]) -> None:
        self.lines = lines
        self.asked: list[str] = []

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += [r.id for r in requests]
        return [self._say(r) for r in requests]

    def _say(self, request: Request) -> Completion:
        line = self.lines.get(request.id, sure("IDLE", request.role))
        if isinstance(line, Completion):
            return line
        return Completion(request.id, line, None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        return {"engine": "scripted"}


def failed(request_id: str, error: str) -> Completion:
    return Completion(request_id, "", None, None, "error", None, 1, error)


def says(p: Sequence[float], role: str = "ego", actions: Sequence[str] = ("SLOWER", "IDLE", "FASTER")) -> str:
    body: dict[str, Any] = {"action_distribution": dict(zip(actions, p, strict=True))}
    return json.dumps(body if role == "ego" else {"evidence": "clear", "risk": "low", **body})


def sure(action: str, role: str = "ego") -> str:
    return says([float(a == action) for a in ("SLOWER", "IDLE", "FASTER")], role)


def with_outcomes(dataset: Dataset, steps: int, outcomes: Mapping[str, Mapping[str, float | str]]) -> Dataset:
    """The scenes' first steps, with a made-up outcome table: seconds to clear, or how it fails."""
    scenes = []
    for scene in dataset.scenes:
        if scene.record["step"] < steps and scene.id in outcomes:
            made = {
                action: {"result": "cleared", "time_s": end} if isinstance(end, float)
                else {"result": end, "time_s": 5.0}
                for action, end in outcomes[scene.id].items()
            }  # fmt: skip
            scenes.append(replace(scene, record={**scene.record, "outcomes": made}))
    return replace(dataset, scenes=tuple(scenes))
