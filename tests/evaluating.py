"""Evaluations as tests make them: the real parts, or the real parts around answers from a script."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.coordination.operating_point import POINTS, OperatingPoint
from harness.dataset.load import Dataset
from harness.evaluate.asking import ask_all, requests
from harness.evaluate.evaluate import Evaluated, evaluate
from harness.evaluate.intents import Answered, intents
from harness.evaluate.scoring import Scored, draw, score
from harness.evaluate.spec import Spec
from harness.evaluate.success import Table, table
from harness.prompts import versions as prompts

FILES = ("rows.jsonl", "episodes.csv", "summary.csv")


def spec_of(dataset: Dataset, model: str = "proxy", prompt: str = "v2", **options: Any) -> Spec:
    options = {"points": tuple(POINTS.values()), "seeds": (0, 1), **options}
    return Spec(cards.resolve(model), prompts.load(prompt), dataset, **options)


def run(spec: Spec, out: Path, resume: bool = False) -> Evaluated:
    return evaluate(spec, out, resume, lambda done: None)


def rows_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "rows.jsonl").read_text(encoding="utf-8").splitlines()]


def decisions(rows: list[dict[str, Any]], condition: str) -> list[dict[str, Any]]:
    return [d for row in rows for d in row["decisions"] if d["condition"] == condition]


def figure(done: Evaluated, condition: str, metric: str, interval: str = "episodes") -> Any:
    """The one row of a summary that says this."""
    t = done.summary
    [row] = t[(t.condition == condition) & (t.metric == metric) & (t.interval == interval)].itertuples()
    return row


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


def ask(spec: Spec, backend: Backend, folder: Path) -> Answered:
    """Every answer asked for and read."""
    by_id = ask_all(
        spec, backend, requests(spec, spec.dataset.scenes), folder / "answers.jsonl", lambda done: None
    )
    return intents(spec.dataset, by_id, spec.answer, spec.thinking)


def scored(
    spec: Spec, known: Answered, point: OperatingPoint, seed: int = 0, infer_s: float = 0.1
) -> tuple[Table, Scored]:
    laid = table(spec.dataset)
    timed = replace(known, inference_s=np.full(known.distance_m.shape, infer_s))
    return laid, score(laid, timed, point, seed, draw(laid, seed, known.valid.shape))


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
