"""Where a decision's inference time comes from: measured at batch 1, or declared by the model card."""

import json
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.arrays import Floats
from harness.backends.base import Backend
from harness.files import canonical_json, write_whole
from harness.run.asking import Answer, requests
from harness.run.spec import Spec

SAMPLE = 5  # scenes timed one request at a time where answers come in batches


def measure(spec: Spec, backend: Backend, kept: Path) -> dict[str, Any]:
    """The latency a run will use, decided once and kept, so that a resumed run uses the same.

    Returns:
        `source` (`card` or `measured`), `inference_s` by role (None where each answer's own time counts),
        `basis`, and for a sample its `n` by role.
    """
    card = spec.card.latency
    if card.source == "card":
        return {
            "source": "card",
            "inference_s": dict.fromkeys(("ego", "helper"), card.inference_s),
            "basis": card.basis,
        }
    if kept.is_file():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    if spec.batch_size == 1 or spec.card.engine == "replay":
        latency: dict[str, Any] = {
            "source": "measured",
            "inference_s": None,
            "basis": "each answer alone, batch 1",
        }
    else:
        latency = _sample(spec, backend)
    write_whole(kept, canonical_json(latency))
    return latency


def _sample(spec: Spec, backend: Backend) -> dict[str, Any]:
    scenes = spec.dataset.scenes[:: max(1, len(spec.dataset.scenes) // SAMPLE)][:SAMPLE]
    times: dict[str, list[float]] = {"ego": [], "helper": []}
    asked = list(requests(spec, scenes))
    backend.complete(asked[:1])  # the first answer pays for warming up
    for request in asked:
        seconds = backend.complete([request])[0].seconds
        if seconds is not None:
            times[request.role].append(seconds)
    known = {role: statistics.median(t) for role, t in times.items() if t}
    fill = max(known.values(), default=None)
    return {
        "source": "measured",
        "inference_s": {role: known.get(role, fill) for role in times},
        "basis": "median of single requests (batch 1) on this machine, before the run",
        "n": {role: len(t) for role, t in times.items()},
    }


def inference_s(latency: Mapping[str, Any], answers: list[list[Answer | None]]) -> Floats:
    """Seconds of inference, (n, 1+H): the ego first. NaN where nobody was asked or no time is known."""
    fixed = latency["inference_s"]
    seconds = np.full((len(answers), len(answers[0])), np.nan)
    for i, row in enumerate(answers):
        for j, answer in enumerate(row):
            if answer is not None:
                value = answer["seconds"] if fixed is None else fixed["ego" if j == 0 else "helper"]
                seconds[i, j] = np.nan if value is None else value
    return seconds
