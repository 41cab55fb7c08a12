"""A small run folder from a real dataset:
a rule answers in the models' place, the rest is the harness.
"""

from collections.abc import Sequence
from itertools import chain

import msgspec
from evaluating import all_scenes, says, spec_of
from run_on_disk import restated

from harness.backends.base import Completion
from harness.core.versions import FIGURES
from harness.evaluate.answers import answer_of
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.latency import PAPER
from harness.evaluate.requests import requests
from harness.evaluate.table import table
from harness.evaluate.walk import walk
from harness.runs import formats, writer
from harness.runs.answer_counts import counts
from harness.runs.answer_times import times
from harness.runs.grid import Grid
from harness.runs.records import Manifest
from harness.runs.summary import Figures, counted

SEEDS = (0, 1, 2)


def write_run(
    out, dataset, model="rule-of-thumb", change=lambda answer: answer, points=None, **stated
):
    """Write a run. `change` may replace any answer; `stated` are further fields of run.json."""
    spec = spec_of(dataset, seeds=SEEDS, latency="paper", **({"points": points} if points else {}))
    asked = list(requests(spec, all_scenes(dataset)))
    answers = [change(answer_of(request, _completion(request))) for request in asked]
    asker = Asker(spec, _nobody, PAPER, answers={answer.id: answer for answer in answers})
    world = FrozenWorld(dataset, spec.points, SEEDS)
    decided = list(chain.from_iterable(walk(world, spec.points, asker, spec.ties)))
    decisions = table(decided, world.columns(), dataset.actions).rounded()
    answers = [answer for answer in answers if answer.scene in decisions.scenes]
    grid = Grid(tuple(point.name for point in spec.points), SEEDS, dataset.episodes)
    episodes = counted(grid, decisions, world.episodes())
    manifest = {
        "format": formats.FORMAT, "name": out.name, "created": "2025-01-01T00:00:00+00:00",
        "command": "harness eval --model rule-of-thumb", "tags": [], **spec.record(),
        "model": {"name": model, "engine": "rule", "description": "brakes for what it sees"},
        "prompt": {"version": "v2", "sha256": "00" * 32, "released": True},
        "latency": PAPER, "identity": {"engine": "rule"},
        "answer_times": times(answers),
        **counts(answers),
        "versions": {**dataset.manifest.versions, "figures": str(FIGURES)},
    }  # fmt: skip
    writer.write(
        out,
        msgspec.convert(
            formats.upgraded(msgspec.to_builtins(restated(manifest, stated))), Manifest
        ),
        decisions,
        episodes,
        [writer.lines(writer.ordered(answers, decisions))],
        Figures.of("frozen", grid, decisions, episodes, answers).scores(),
    )
    return out


def _nobody():
    raise AssertionError("every answer is there")


def _completion(request):
    """It brakes for what is close, is careful where it sees little, and fails now and then."""
    graph = request.view
    close = [c for c in graph.conflicts if abs((c.ego.time_s or 99) - (c.other.time_s or 99)) < 1.5]
    blind = any(s.occluded for s in graph.sectors)
    p: Sequence[float] = (
        (0.9, 0.08, 0.02) if close else (0.3, 0.4, 0.3) if blind else (0.05, 0.8, 0.15)
    )
    text = says(p, request.role, request.actions)
    place = graph.step, graph.viewer
    if place == (2, "v3"):
        text = f"```json\n{text}\n```"
    if place == (4, "v4"):
        text = "I would slow down."
    return Completion(request.id, text, None, None, "stop", None, 1)
