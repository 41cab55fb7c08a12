"""Where a decision's inference time comes from: measured at batch 1, the model card, or the paper."""

import os
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from harness.backends.base import Backend, Request, Timed
from harness.backends.cache import Cached
from harness.backends.registry import capabilities
from harness.core.arrays import Floats
from harness.core.files import write_whole
from harness.evaluate.spec import Spec
from harness.runs.records import Answer, Latency

PAPER = Latency("paper", "cited: SwarmDrive paper, single local 145.0 ms", 0.145, 0.145, 0.145)
SAMPLE = 5  # scenes timed one request at a time where answers come in batches


def declared(spec: Spec, backend: Backend) -> Latency | None:
    """The latency that the paper, the run replayed or the card declares; None where it is to be measured."""
    if spec.latency == "paper":
        return PAPER
    if capabilities(spec.card.engine).own_latency:
        return cast("Timed", backend).latency()
    card = spec.card.latency
    if (spec.latency or card.source) == "card":
        return Latency("card", card.basis, card.inference_s, card.inference_s, card.inference_s)
    return None


def measured(spec: Spec, backend: Backend, asked: Sequence[Request]) -> Latency:
    """The latency of a backend at these requests; each answer's own time where batches are of one."""
    backend.complete(asked[:1])  # the first answer of a process pays for warming up
    if spec.batch_size == 1:
        return Latency("measured", "each answer alone, batch 1", None, None)
    return timed(backend, asked)


def kept(file: Path) -> Latency | None:
    """The latency that a run began with; None if there is none yet."""
    return msgspec.json.decode(file.read_bytes(), type=Latency) if file.is_file() else None


def keep(file: Path, latency: Latency) -> Latency:
    """Write it down, so that a resumed run uses the same."""
    write_whole(file, msgspec.json.encode(latency))
    return latency


def lacks_times(answers: Mapping[str, Answer]) -> bool:
    """Whether some role has answers from the cache, which have no time, and no other that has one.

    Where each answer's own time counts, a timed sample must then stand for every answer of the run. Fusion
    calls, which a resumed run may have already, are timed by themselves.
    """
    first = [answer for answer in answers.values() if not answer.heard]
    timed_roles = {answer.role for answer in first if answer.seconds is not None}
    return not {answer.role for answer in first if answer.cached} <= timed_roles


def sample(items: Sequence[Any]) -> Sequence[Any]:
    """`SAMPLE` of them, evenly spread."""
    return items[:: max(1, len(items) // SAMPLE)][:SAMPLE]


def timed(backend: Backend, asked: Sequence[Request]) -> Latency:
    """The median time of a role's answers, each asked alone, and of the backend itself."""
    backend = backend.backend if isinstance(backend, Cached) else backend
    times: dict[str, list[float]] = {"ego": [], "helper": []}
    for request in asked:
        answer = backend.complete([request])[0]
        if answer.seconds is not None and answer.error is None:
            times[request.role].append(answer.seconds)
    medians = {role: statistics.median(t) for role, t in times.items() if t}
    fill = max(medians.values(), default=None)
    return Latency(
        "measured", "median of single requests (batch 1) on this machine, before the run",
        medians.get("ego", fill), medians.get("helper", fill), n={role: len(t) for role, t in times.items()},
        load_a_core=_load(),
    )  # fmt: skip


def lacks_fusion(latency: Latency, answers: Mapping[str, Answer]) -> bool:
    """Whether the time of fusion calls is still to be measured: none is declared, and no answer has one."""
    own = latency.each_its_own and any(a.heard and a.seconds is not None for a in answers.values())
    return latency.fusion_s is None and "merge" not in latency.n and not own


def with_fusion(latency: Latency, backend: Backend, asked: Sequence[Request]) -> Latency:
    """With the time of a fusion call, measured on a sample of these if none is declared."""
    sampled = timed(backend, sample(asked))
    return replace(latency, fusion_s=sampled.ego_s, n={**latency.n, "merge": sampled.n["ego"]})


def inference_s(
    latency: Latency, answers: Sequence[Sequence[Answer | None]], every: Mapping[str, Answer]
) -> Floats:
    """Seconds of inference, (n, 1+H): the ego first. NaN where nobody was asked or no time is known.

    Where each answer's own time counts, one that has none, since it comes from the cache or its engine
    failed, takes its role's median over `every` answer. What an answer is declared to be slower than its card
    comes on top of the card's.
    """
    asked = np.array([[a is not None for a in row] for row in answers])
    if latency.each_its_own:
        own = np.array([[a.seconds if a else None for a in row] for row in answers], dtype=float)
        typical = np.array([_median(every, "ego"), *[_median(every, "helper")] * (own.shape[1] - 1)])
        return np.where(asked & np.isnan(own), typical, own)
    by_place = np.array([latency.ego_s, *[latency.helper_s] * (asked.shape[1] - 1)], dtype=float)
    slow = np.array([[a.slow_s if a else 0.0 for a in row] for row in answers])
    return np.where(asked, by_place + slow, np.nan)


def fusion_s(latency: Latency, answers: Sequence[Answer], every: Mapping[str, Answer]) -> Floats:
    """Seconds of each fusion call, (K,), as `inference_s` has those of the first answers."""
    if latency.fusion_s is None:
        own = np.array([a.seconds for a in answers], dtype=float)
        return np.where(np.isnan(own), _median(every, "merge"), own)
    return np.array([latency.fusion_s + a.slow_s for a in answers])


def _median(answers: Mapping[str, Answer], role: str) -> float:
    seconds = [a.seconds for a in answers.values() if a.role == role and a.seconds is not None]
    return statistics.median(seconds) if seconds else np.nan


def _load() -> float | None:
    """Processes that wanted a core in the last minute, a core; None where the system does not say."""
    try:
        return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)
    except (OSError, AttributeError):
        return None
