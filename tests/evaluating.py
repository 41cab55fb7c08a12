"""Evaluations as tests make them: the real parts,
or the real parts around answers from a script.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import former
import msgspec

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.core.progress import Progress
from harness.core.work import tidy
from harness.dataset.load import Dataset, Scene, Trees
from harness.dataset.schema import Branching, Edge, End
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.fusion import messages_of
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.live_world import LiveSource
from harness.evaluate.requests import requests
from harness.evaluate.run import evaluate
from harness.evaluate.sharing import as_asked
from harness.evaluate.spec import Source, Spec
from harness.evaluate.table import table
from harness.evaluate.walk import Decided, walk
from harness.prompts import versions as prompts
from harness.report.details import prompts_of
from harness.runs import folder, writer
from harness.runs.decisions import Decisions
from harness.runs.grid import Grid
from harness.runs.headline import PAIRED
from harness.runs.records import Answer, Decision, Episode, Latency, Score
from harness.runs.settings import Settings
from harness.runs.summary import Figures, counted
from harness.world.drivers import DRIVERS

FILES = ("answers.jsonl", "decisions.parquet", "episodes.csv", "summary.csv")


def spec_of(
    dataset: Dataset,
    model: str = "proxy",
    prompt: str = "v2",
    limit: int | None = None,
    **options: Any,
) -> Spec:
    options = {"points": tuple(POINTS.values()), "seeds": (0, 1), **options}
    asked = {name: options.pop(name) for name in ("answer", "thinking") if name in options}
    ego = Agent(cards.resolve(model), prompts.load(prompt), **asked)
    return made(ego, FrozenSource(dataset, limit), **options)


def made(ego: Agent, source: Source, **options: Any) -> Spec:
    """An evaluation of what is opened and of plain settings, each by its name."""
    plain = {*Settings.__struct_fields__} - Spec.__dataclass_fields__.keys()
    settings = Settings(**{name: options.pop(name) for name in plain & options.keys()})
    return Spec(ego, source, settings=settings, **options)


def with_ego(spec: Spec, **changes: Any) -> Spec:
    """The evaluation with another card, prompt, answer mode or thinking."""
    return replace(spec, ego=replace(spec.ego, **changes))


def live_spec_of(
    model: str = "proxy", episodes: int = 2, first_seed: int = 0, prompt: str = "v2", **options: Any
) -> Spec:
    options = {"points": tuple(POINTS.values()), "seeds": (0, 1), **options}
    ego = Agent(cards.resolve(model), prompts.load(prompt))
    return made(ego, LiveSource(first_seed, episodes, former.NAME), **options)


def run(spec: Spec, out: Path) -> Evaluated:
    done = evaluate(spec, out, lambda done: None)
    tidy(out)
    return done


def figure(done: "Evaluated | Walked", condition: str, metric: str, interval: str = "") -> Score:
    """The one row of a summary that says this."""
    usual = PAIRED if "gain" in metric else "episodes"
    wanted = (condition, metric, interval or usual)
    [score] = [s for s in done.scores if (s.condition, s.metric, s.interval) == wanted]
    return score


def same_files(one: Path, other: Path) -> bool:
    """Whether two runs have the same tables:
    bytes, and of decisions.parquet values and their types.
    """
    texts = [name for name in FILES if name != "decisions.parquet"]
    return same_decisions(one, other) and all(
        (one / name).read_bytes() == (other / name).read_bytes() for name in texts
    )


def same_decisions(one: Path, other: Path) -> bool:
    """Whether two runs have the same decisions.parquet: values and their types."""
    tables = [folder.read(run).decisions.table for run in (one, other)]
    return bool(tables[0].equals(tables[1]))


def same_scores(one: Evaluated, other: Evaluated) -> bool:
    """Whether two summaries say the same, whoever the model was."""
    return list(one.scores) == list(other.scores)


def decisions(out: Path, condition: str | None = None) -> list[Decision]:
    """A run's decisions under a condition, by scene and seed."""
    found = folder.read(out).decisions
    return [d for d in found.records(0, len(found)) if condition in (None, d.condition)]


A_TENTH = Latency("card", "declared: for this test", 0.1, 0.1, 0.1)


@dataclass(frozen=True)
class Walked:
    """A walk through frozen scenes: what was decided, and what a run's tables would have of it."""

    parts: Sequence[Decided[Scene]]
    decisions: Decisions
    episodes: Sequence[Episode]
    answers: Sequence[Answer]
    scores: Sequence[Score]

    def result(self, point: OperatingPoint, name: str, seed: int = 0) -> list[Any]:
        """A field of the coordination in each scene, in the order of their names."""
        by_scene = {
            part.decision_points[at].id: getattr(part.result, name)[row]
            for part in self.parts if part.point == point
            for row, (at, its_seed) in enumerate(zip(part.due.at, part.due.seed, strict=True))
            if its_seed == seed
        }  # fmt: skip
        return [by_scene[scene] for scene in sorted(by_scene)]

    def records(self, condition: str) -> list[Decision]:
        """The decisions under a condition, by scene and seed."""
        found = self.decisions.records(0, len(self.decisions))
        return [decision for decision in found if decision.condition == condition]


def asker_of(
    spec: Spec, backend: Backend, latency: Latency = A_TENTH, kept: Path | None = None
) -> Asker:
    """An asker that has asked about every scene."""
    asker = Asker(spec, lambda: backend, latency, kept)
    assert isinstance(spec.source, FrozenSource)
    asker.ask(list(requests(spec, all_scenes(spec.source.dataset))))
    return asker


def all_scenes(dataset: Dataset) -> list[Scene]:
    """Every scene of a dataset's trees, in their order."""
    return dataset.scenes(dataset.forest.ids)


def as_read(
    stored: folder.Run, dataset: Dataset
) -> Iterator[tuple[Answer, Sequence[Any], Sequence[Any]]]:
    """Each answer of a run, the messages that it heard,
    and the chat that a reader is shown for it.
    """
    sent = prompts_of(stored)
    assert sent is not None
    scenes = {scene.id: scene for scene in all_scenes(dataset)}
    for name, answers in stored.answers_by_scene.items():
        by_key = {answer.key: answer for answer in answers}
        for answer in answers:
            heard = messages_of(by_key, answer.heard, dataset.actions)
            shown = as_asked(dataset.scenario, scenes[name], answer)
            yield answer, heard, sent(shown, answer.viewer, heard)


def scenes_of(dataset: Dataset) -> list[Scene]:
    """The scenes on the reference drivers' courses, by episode and step."""
    return dataset.scenes(dataset.courses())


def walked(
    spec: Spec, backend: Backend, latency: Latency = A_TENTH, kept: Path | None = None
) -> Walked:
    """A whole evaluation but for its folder: asked, walked and scored."""
    asker = Asker(spec, lambda: backend, latency, kept)
    assert isinstance(spec.source, FrozenSource)
    world = FrozenWorld(spec.source.dataset, spec.points, spec.seeds)
    parts = list(chain.from_iterable(walk(world, spec.points, asker, spec.ties)))
    made = table(parts, world.columns(), spec.actions)
    grid = Grid(
        tuple(point.name for point in spec.points), spec.seeds, spec.source.dataset.episodes
    )
    episodes = counted(grid, made, world.episodes())
    answers = writer.ordered(asker.answers.values(), made)
    return Walked(
        parts, made, episodes, answers, Figures.of("frozen", grid, made, episodes, answers).scores()
    )


class Watched(Progress):
    """Notes what it is told, and calls `then` for what is done."""

    def __init__(self, then: Callable[[int], object] = lambda done: None) -> None:
        self.then = then
        self.done, self.asked, self.events = list[int](), list[int](), list[str]()

    def __call__(self, done: int) -> None:
        self.done.append(done)
        self.then(done)

    def more(self, count: int) -> None:
        self.asked.append(count)
        self.events.append(str(count))

    def say(self, text: str) -> None:
        self.events.append(text)


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


def says(
    p: Sequence[float], role: str = "ego", actions: Sequence[str] = ("SLOWER", "IDLE", "FASTER")
) -> str:
    body: dict[str, Any] = {"action_distribution": dict(zip(actions, p, strict=True))}
    return json.dumps(body if role == "ego" else {"evidence": "clear", "risk": "low", **body})


def sure(action: str, role: str = "ego") -> str:
    return says([float(a == action) for a in ("SLOWER", "IDLE", "FASTER")], role)


def course(dataset: Dataset, steps: int = 6, outcomes: Mapping[str, Mapping[str, float | str]] | None = None,
           driver: str = "cruise", drives: Mapping[str, str] | None = None) -> Dataset:  # fmt: skip
    """Trees with one branch: whatever is decided leads to the next scene of a driver's course.

    Scenes are called `<episode>-<step>`. An action ends the episode where `outcomes`, by scene and
    action, has how: seconds until cleared, or the failure. At the last step every action does, by
    default cleared after 5 s.

    Args:
        dataset: whose scenes are taken.
        steps: at most, of each episode.
        outcomes: how actions end. If given, scenes that it has not are left out.
        driver: whose course it is.
        drives: what every reference driver does in a scene, the full-view driver too; else IDLE.
    """
    forest, trees, scenes = dataset.forest, [], {}
    visited = [forest.ids[n] for n in forest.visited(forest.drivers[driver]).tolist()]
    for tree in dataset.trees:
        mine = [name for name in visited if name.startswith(f"{tree.episode:05d}-")][:steps]
        named = {name[:7]: scene for name, scene in zip(mine, dataset.scenes(mine), strict=True)}
        if outcomes is not None:
            named = {name: scene for name, scene in named.items() if name in outcomes}
        if not named:
            continue
        for name, scene in named.items():
            scenes[name] = scene.changed(scene=name)
        levels = [
            [Branching(name, dict.fromkeys(DRIVERS, (drives or {}).get(name, "IDLE")), [
                _edge(action, (outcomes or {}).get(name, {}).get(action), last=step == len(named) - 1)
                for action in dataset.actions
            ])]
            for step, name in enumerate(named)
        ]  # fmt: skip
        trees.append(msgspec.structs.replace(tree, levels=levels))
    made = {tree.episode: tree for tree in trees}
    return replace(dataset, trees=Trees(made, made.__getitem__), _scenes=scenes)


def _edge(action: str, outcome: float | str | None, last: bool) -> Edge:
    if outcome is None and not last:
        return Edge([action], 0, None, 1.0, 0, 0)
    how, time_s = (outcome, 5.0) if isinstance(outcome, str) else ("cleared", outcome or 5.0)
    return Edge([action], None, End(how, time_s, None, None, None), 1.0, 0, 0)  # type: ignore[arg-type]
