"""Where a decision's inference time comes from: measured at batch 1, the model card, or the paper."""

import json
import os
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from harness.backends.base import Backend, Request, Timed
from harness.backends.registry import capabilities
from harness.core.arrays import Floats
from harness.core.files import canonical_json, write_whole
from harness.dataset.load import Scene
from harness.evaluate.asking import Answer, requests
from harness.evaluate.spec import Spec

PAPER = {
    "source": "paper",
    "inference_s": {"ego": 0.145, "helper": 0.145},
    "merge_s": 0.145,
    "basis": "cited: SwarmDrive paper, single local 145.0 ms",
}
SAMPLE = 5  # scenes timed one request at a time where answers come in batches


def measure(spec: Spec, backend: Backend, kept: Path) -> dict[str, Any]:
    """The latency a run will use, decided once and kept, so that a resumed run uses the same.

    Returns:
        `source` (`card`, `measured` or `paper`), `inference_s` by role (None where each answer's own time
        counts), `basis`, and for a sample its `n` by role and the machine's load. `merge_latency` adds
        `merge_s` where it is needed.
    """
    if spec.latency == "paper":
        return PAPER
    if capabilities(spec.card.engine).own_latency:
        return cast("Timed", backend).latency()
    card = spec.card.latency
    if (spec.latency or card.source) == "card":
        return {
            "source": "card",
            "inference_s": dict.fromkeys(("ego", "helper"), card.inference_s),
            "basis": card.basis,
        }
    first, *_ = asked = list(requests(spec, _sample(spec.dataset.scenes)))
    backend.complete([first])  # the first answer of a process pays for warming up
    if kept.is_file():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    if spec.batch_size == 1:
        latency: dict[str, Any] = {
            "source": "measured",
            "inference_s": None,
            "basis": "each answer alone, batch 1",
        }
    else:
        latency = _timed(backend, asked)
    write_whole(kept, canonical_json(latency))
    return latency


def settled(
    spec: Spec, backend: Backend, latency: dict[str, Any], answers: Mapping[str, Answer], kept: Path
) -> dict[str, Any]:
    """The latency, once everything is answered: it may be that no answer of a role has a time of its own.

    Where each answer's own time counts, one that comes from the cache has none. If a role has no other, a
    sample is timed as it is for batches, and stands for every answer of the run; it is kept as well.
    """
    if latency["inference_s"] is not None or capabilities(spec.card.engine).own_latency:
        return latency
    asked = list(requests(spec, spec.dataset.scenes))
    timed = {r.role for r in asked if answers[r.id]["seconds"] is not None}
    if {r.role for r in asked if answers[r.id]["cached"]} <= timed:
        return latency
    latency = _timed(backend, list(requests(spec, _sample(spec.dataset.scenes))))
    write_whole(kept, canonical_json(latency))
    return latency


def merge_latency(
    spec: Spec, backend: Backend, latency: dict[str, Any], asked: Sequence[Request],
    answers: Mapping[str, Answer], kept: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The latency with `merge_s`, the seconds of the ego's second inference; None for each answer's own.

    Declared like any other inference, or timed on a sample of the second questions `asked`, as the first ones
    are.
    """
    if not asked or "merge_s" in latency:
        return latency
    if latency["source"] == "card":
        return {**latency, "merge_s": latency["inference_s"]["ego"]}
    if latency["inference_s"] is None and any(answers[r.id]["seconds"] is not None for r in asked):
        return {**latency, "merge_s": None}
    timed = _timed(backend, asked[:: max(1, len(asked) // SAMPLE)][:SAMPLE])
    found = {**latency, "merge_s": timed["inference_s"]["ego"], "n_merge": timed["n"]["ego"]}
    if kept:
        write_whole(kept, canonical_json(found))
    return found


def merge_s(latency: Mapping[str, Any], answers: Sequence[Answer]) -> Floats:
    """Seconds of each second inference, (K,), as `inference_s` has those of the first."""
    own = np.array([a["seconds"] for a in answers], dtype=float)
    fixed = latency["merge_s"] if answers else None
    if fixed is None:
        return np.where(np.isnan(own), _median(own), own)
    return np.array([fixed + a["slow_s"] for a in answers])


def _sample(scenes: Sequence[Scene]) -> Sequence[Scene]:
    return scenes[:: max(1, len(scenes) // SAMPLE)][:SAMPLE]


def _timed(backend: Backend, asked: Sequence[Request]) -> dict[str, Any]:
    times: dict[str, list[float]] = {"ego": [], "helper": []}
    for request in asked:
        answer = backend.complete([request])[0]
        if answer.seconds is not None and answer.error is None:
            times[request.role].append(answer.seconds)
    known = {role: statistics.median(t) for role, t in times.items() if t}
    fill = max(known.values(), default=None)
    return {
        "source": "measured",
        "inference_s": {role: known.get(role, fill) for role in times},
        "basis": "median of single requests (batch 1) on this machine, before the run",
        "n": {role: len(t) for role, t in times.items()},
        "load_a_core": _load(),
    }


def _load() -> float | None:
    """Processes that wanted a core in the last minute, a core; None where the system does not say."""
    try:
        return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)
    except (OSError, AttributeError):
        return None


def inference_s(latency: Mapping[str, Any], answers: list[list[Answer | None]]) -> Floats:
    """Seconds of inference, (n, 1+H): the ego first. NaN where nobody was asked or no time is known.

    Where each answer's own time counts, one that has none, since it comes from the cache or its engine
    failed, takes its role's median. What an answer is declared to be slower than its card comes on top of
    the card's.
    """
    asked = np.array([[a is not None for a in row] for row in answers])
    fixed = latency["inference_s"]
    if fixed is None:
        own = np.array([[a["seconds"] if a else None for a in row] for row in answers], dtype=float)
        typical = [_median(own[:, :1]), *[_median(own[:, 1:])] * (own.shape[1] - 1)]
        return np.where(asked & np.isnan(own), typical, own)
    by_place = np.array([fixed["ego"], *[fixed["helper"]] * (asked.shape[1] - 1)], dtype=float)
    slow = np.array([[a["slow_s"] if a else 0.0 for a in row] for row in answers])
    return np.where(asked, by_place + slow, np.nan)


def _median(seconds: Floats) -> float:
    known = seconds[~np.isnan(seconds)]
    return float(np.median(known)) if len(known) else np.nan
