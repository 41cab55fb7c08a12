"""Measure inference times before a run;
only if the user asks for it, and only on an idle machine.
"""

import os
from collections.abc import Sequence
from dataclasses import replace

from harness.backends.base import Backend
from harness.core.errors import Unanswered, UserError, printable
from harness.dataset.load import Scene
from harness.evaluate.answers import answer_of
from harness.evaluate.latency import EXAMPLE
from harness.evaluate.requests import fusion_request, requests
from harness.evaluate.spec import Spec
from harness.runs.answer_times import times
from harness.runs.records import MEASURED, Latency
from harness.runs.unanswered import Tally

SCENES = 5  # how many scenes are timed
IDLE = 0.25  # highest load of an idle machine, in processes a core


def refuse_busy() -> None:
    """Raise UserError if the machine was busy in the last minute, or does not tell its load."""
    load = load_a_core()
    if load is None or load > IDLE:
        reason = (
            "this system does not say how busy it is"
            if load is None
            else f"the machine is busy ({load:.2f} processes a core in the last minute; at most "
            f"{IDLE:g})"
        )
        wait = "" if load is None else "wait until it is idle, or "
        raise UserError(
            f"--latency {MEASURED}: {reason}; {wait}declare times with --latency paper or {EXAMPLE}"
        )


def load_a_core() -> float | None:
    """Return the mean number of running processes a core, of the last minute; None if unknown."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (OSError, AttributeError):
        return None


def spread_over(scenes: Sequence[Scene]) -> Sequence[Scene]:
    """Return some of these scenes, evenly spread, to time a model on: at most `SCENES`."""
    return scenes[:: max(1, len(scenes) // SCENES)][:SCENES]


def measured(spec: Spec, backend: Backend, scenes: Sequence[Scene]) -> Latency:
    """Measure how long a model takes to answer: the median seconds by role, each request alone.

    `spec` is the evaluation, and `scenes` are those to ask about. A role in which no answer can be
    timed gets the ego's time. `backend` must be the model itself: a cache would answer in no time.
    Raises Unanswered if the ego's requests got no answer, and UserError if none of its answers
    could be timed.
    """
    first = [replace(request, timed=True) for request in requests(spec, scenes)]
    backend.complete(first[:1])  # the first request of a process includes the warm-up
    answers = {r.id: answer_of(r, backend.complete([r])[0]) for r in first}
    fusion = []
    for scene in scenes if spec.fusion_obstacle is None else ():
        by_viewer = {viewer: answers[f"{scene.id}/{viewer}"] for viewer in scene.viewers}
        heard = [viewer for viewer in scene.viewers[1:] if by_viewer[viewer].intent]
        if heard:
            fusion.append(replace(fusion_request(spec, scene, by_viewer, heard), timed=True))
    sample = times([*answers.values(), *(answer_of(r, backend.complete([r])[0]) for r in fusion)])
    if "ego" not in sample:
        if (tally := Tally(answers.values())).unanswered["ego"]:
            raise Unanswered(str(tally))
        name = printable(spec.ego.card.name)
        raise UserError(
            f"--latency {MEASURED}: no answer of {name} could be timed in {len(scenes)} scenes; "
            f"see what `harness model check` says, or declare times such as {EXAMPLE}"
        )
    ego_s, helper_s, fusion_s = (
        sample.get(role, sample["ego"]).median_s for role in ("ego", "helper", "merge")
    )
    several_helpers = len(spec.helpers) > 1
    helper_times: list[float] = []
    for agent in range(1, len(spec.agents) if several_helpers else 1):
        of_agent = times(answers[request.id] for request in first if request.agent == agent)
        helper_times.append(of_agent.get("helper", sample["ego"]).median_s)
    basis = f"median of single requests (batch 1) before the run, at most {IDLE:g} processes a core"
    helper_s = helper_times[0] if helper_times else helper_s
    return Latency(MEASURED, basis, ego_s, helper_s, fusion_s, sample, tuple(helper_times))
