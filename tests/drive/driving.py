"""The closed loop as tests walk it: the real parts,
or the real parts around answers from a script.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from evaluating import live_spec_of, says

from harness.backends.base import Backend, Completion, Request
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.evaluate.asking import Asker
from harness.evaluate.latency import chosen_latency
from harness.evaluate.live_world import LiveSource, LiveWorld
from harness.evaluate.spec import Spec
from harness.evaluate.table import table
from harness.evaluate.walk import walk
from harness.runs import writer
from harness.runs.decisions import Decisions
from harness.runs.grid import Grid
from harness.runs.records import Answer, Decision, Episode, Latency
from harness.runs.summary import counted

NO_DANGER, FROM_RIGHT, FROM_LEFT, ONCOMING = 0, 1, 6, 10  # layout seeds
ALONE = POINTS["single-local"]


class Script:
    """A backend whose answers are a function of who is asked when;
    `fused` is any answer to a fusion call.
    """

    def __init__(
        self, line: Callable[[str, int], Sequence[float]], fused: Sequence[float] = (0.0, 1.0, 0.0)
    ) -> None:
        self.line, self.fused = line, fused
        self.asked: list[str] = []

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._say(request) for request in requests]

    def _say(self, request: Request) -> Completion:
        self.asked.append(request.id)
        p = (
            self.line(request.view.viewer, request.view.step)
            if "+" not in request.id
            else self.fused
        )
        return Completion(request.id, says(p, request.role), None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        return {"engine": "script"}


@dataclass(frozen=True)
class Driven:
    """What a run has of some episodes: decisions as written, episodes by place,
    answers in a run's order.
    """

    decisions: Decisions
    episodes: list[Episode]
    answers: list[Answer]

    @property
    def decision_points(self) -> int:
        """How many distinct decision points somebody decided in."""
        return len(self.decisions.scenes)


def spec(
    model: str = "proxy",
    points: Sequence[OperatingPoint] = tuple(POINTS.values()),
    seeds: Sequence[int] = (0, 1),
    **options: Any,
) -> Spec:
    return live_spec_of(model, points=tuple(points), seeds=tuple(seeds), **options)


def driven(
    of: Spec,
    episodes: Sequence[int] = (0,),
    backend: Backend | None = None,
    infers: float | Latency | None = None,
) -> Driven:
    """Walk some episodes of the closed loop, every inference taking so many seconds,
    or what it would in a run.
    """
    assert isinstance(of.source, LiveSource)
    opened = backend or open_backend(of.ego.card, batch_size=of.settings.batch_size)
    latency = chosen_latency(of.settings.latency, of.agents, [opened])
    if isinstance(infers, Latency):
        latency = infers
    elif infers is not None:
        latency = Latency("card", "test", infers, infers, infers)
    assert latency is not None, "no test measures"
    asker = Asker(of, lambda: opened, latency)
    world = LiveWorld(
        of.source.scenario, of.source.first_seed, episodes, of.points, of.seeds, of.ego_alone
    )
    decisions = table(
        list(chain.from_iterable(walk(world, of.points, asker, of.ties))),
        world.columns(),
        of.actions,
    ).rounded()
    grid = Grid(tuple(point.name for point in of.points), of.seeds, tuple(episodes))
    return Driven(
        decisions,
        counted(grid, decisions, world.episodes()),
        writer.ordered(asker.answers.values(), decisions),
    )


def decisions(made: Driven, condition: str, seed: int = 0) -> dict[int, Decision]:
    """An episode's decisions by step, where there is but one layout."""
    every = made.decisions.records(0, len(made.decisions))
    return {d.step: d for d in every if (d.condition, d.seed) == (condition, seed)}


def column(made: Driven, name: str, condition: str, seed: int = 0) -> dict[int, Any]:
    """A column of the table, by step; None where unknown."""
    rows = made.decisions.table.select(["step", "condition", "seed", name]).to_pylist()
    return {r["step"]: r[name] for r in rows if (r["condition"], r["seed"]) == (condition, seed)}
