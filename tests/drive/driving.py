"""Live runs as tests make them: the real parts, or the real parts around answers from a script."""

from collections.abc import Callable, Sequence
from typing import Any

from evaluating import says
from harness.evaluate.live import drive
from harness.evaluate.live_spec import Drive, spec_of
from harness.runs.driven_record import Row

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.backends.registry import open_backend
from harness.coordination.operating_point import POINTS, OperatingPoint
from harness.prompts import versions as prompts

NO_DANGER, FROM_RIGHT, FROM_LEFT, ONCOMING = 0, 1, 6, 10  # layout seeds
ALONE = POINTS["single-local"]


class Script:
    """A backend whose answers are a function of who is asked when; `merged` is any second answer."""

    def __init__(
        self, line: Callable[[str, int], Sequence[float]], merged: Sequence[float] = (0.0, 1.0, 0.0)
    ) -> None:
        self.line, self.merged = line, merged
        self.asked: list[str] = []

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._say(request) for request in requests]

    def _say(self, request: Request) -> Completion:
        self.asked.append(request.id)
        p = self.line(request.view["viewer"], request.view["step"]) if request.view else self.merged
        return Completion(request.id, says(p, request.role), None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        return {"engine": "script"}


def spec(
    model: str = "proxy",
    points: Sequence[OperatingPoint] = tuple(POINTS.values()),
    seeds: Sequence[int] = (0, 1),
    **options: Any,
) -> Drive:
    return spec_of(cards.resolve(model), prompts.load("v2"), tuple(points), tuple(seeds), **options)


def driven(
    of: Drive, episodes: Sequence[int] = (0,), backend: Backend | None = None, infer_s: float | None = None
) -> tuple[list[Row], list[Row]]:
    """Moments and episodes."""
    inference_s = of.card.latency.inference_s if infer_s is None else infer_s
    latency = {
        "source": "card",
        "inference_s": dict.fromkeys(("ego", "helper"), inference_s),
        "merge_s": inference_s,
        "basis": "test",
    }
    return drive(of, backend or open_backend(of.card, batch_size=of.batch_size), latency, episodes)


def decisions(moments: Sequence[Row], condition: str, seed: int = 0) -> dict[int, Row]:
    """An episode's decisions by step, where there is but one layout."""
    return {
        row["step"]: {**made, "scene": row["scene"]}
        for row in moments
        for made in row["decisions"]
        if (made["condition"], made["seed"]) == (condition, seed)
    }
