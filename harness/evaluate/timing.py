"""Inference times measured before a run: by name only, and on an idle machine only."""

import os
from collections.abc import Sequence
from dataclasses import replace

from harness.backends.base import Backend
from harness.core.errors import UserError, printable
from harness.dataset.load import Scene
from harness.evaluate.asking import answer_of, fusion_request, requests
from harness.evaluate.latency import EXAMPLE, MEASURED, times
from harness.evaluate.spec import Spec
from harness.runs.records import Latency

SCENES = 5  # that are timed
IDLE = 0.25  # processes that want a core, a core, at most


def refuse_busy() -> None:
    """Raise UserError unless the machine has been idle for a minute."""
    load = load_a_core()
    if load is None or load > IDLE:
        reason = (
            "this system does not say how busy it is" if load is None else
            f"the machine is busy ({load:.2f} processes a core in the last minute; at most {IDLE:g})"
        )  # fmt: skip
        wait = "" if load is None else "wait until it is idle, or "
        raise UserError(
            f"--latency {MEASURED}: {reason}; {wait}declare times with --latency paper or {EXAMPLE}"
        )


def load_a_core() -> float | None:
    """Processes that wanted a core in the last minute, a core; None where the system does not say."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (OSError, AttributeError):
        return None


def spread_over(scenes: Sequence[Scene]) -> Sequence[Scene]:
    """So many scenes as are timed, evenly spread."""
    return scenes[:: max(1, len(scenes) // SCENES)][:SCENES]


def measured(spec: Spec, backend: Backend, scenes: Sequence[Scene]) -> Latency:
    """The median time of an agent's answers in a role in these scenes, each asked alone.

    Where no answer can be timed it is the ego's time.

    Args:
        spec: the evaluation.
        backend: the model itself: a cache answers in no time.
        scenes: what is asked about.

    Raises:
        UserError: no answer of the ego can be timed.
    """
    first = [replace(request, timed=True) for request in requests(spec, scenes)]
    backend.complete(first[:1])  # the first answer of a process pays for warming up
    answers = {r.id: answer_of(r, backend.complete([r])[0]) for r in first}
    fusion = []
    for scene in scenes if spec.unmergeable is None else ():
        said = {viewer: answers[f"{scene.id}/{viewer}"] for viewer in scene.viewers}
        if heard := [viewer for viewer in scene.viewers[1:] if said[viewer].intent]:
            fusion.append(replace(fusion_request(spec, scene, said, heard), timed=True))
    sample = times([*answers.values(), *(answer_of(r, backend.complete([r])[0]) for r in fusion)])
    if "ego" not in sample:
        name = printable(spec.ego.card.name)
        raise UserError(
            f"--latency {MEASURED}: no answer of {name} could be timed in {len(scenes)} scenes; see what "
            f"`harness model check` says, or declare times such as {EXAMPLE}"
        )
    ego, helper, merge = (sample.get(role, sample["ego"]).median_s for role in ("ego", "helper", "merge"))
    several = len(spec.helpers) > 1
    of_helpers = tuple(
        times(answers[r.id] for r in first if r.agent == who).get("helper", sample["ego"]).median_s
        for who in range(1, len(spec.agents)) if several
    )  # fmt: skip
    basis = f"median of single requests (batch 1) before the run, at most {IDLE:g} processes a core"
    helper = of_helpers[0] if of_helpers else helper
    return Latency("measured", basis, ego, helper, merge, sample, of_helpers)
