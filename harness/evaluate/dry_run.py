"""Count what an evaluation would ask, without a model."""

from collections import Counter
from itertools import chain
from math import comb
from pathlib import Path
from typing import Any

from harness.backends.tokens import counter, summarize_counts
from harness.coordination.operating_point import Rewrites
from harness.dataset.load import Dataset
from harness.evaluate.asking import EGO, requests
from harness.evaluate.spec import Spec


def count(spec: Spec, dataset: Dataset, tokenizer: Path | None) -> dict[str, Any]:
    """Return the settings, how many requests would be asked about the scenes, and the tokens of prompts.

    Who asks a helper depends on answers: unless all are asked, helpers are asked as often at most. So are
    fusion calls, of which there is one for each set of helpers that may be heard.
    """
    tokens_of = counter(tokenizer, spec.ego.card)
    sizes: dict[str, list[int]] = {}
    asked, scenes = Counter[str](), dataset.scenes(dataset.courses())
    intents = [point for point in spec.points if point.asks and point.content.intent]
    sighted = spec.asks_all or any(not point.blind_helpers for point in intents)
    blind = any(point.blind_helpers for point in (spec.points if spec.asks_all else intents))
    own = requests(spec, scenes, places=None if sighted else [EGO] * len(scenes))
    for request in chain(own, requests(spec, scenes, blind=True) if blind else ()):
        asked[request.role] += 1
        if tokens_of:
            vision = spec.agents[request.agent].card.vision if request.image else None
            tokens = tokens_of(request.messages) + (vision.tokens if vision else 0)
            sizes.setdefault(request.role, []).append(tokens)
    if calls := sum(_fusion_calls(spec, len(scene.viewers) - 1) for scene in scenes):
        asked["fusion"] = calls
    stats = {role: summarize_counts(n) for role, n in sizes.items()}
    return {
        **spec.settings(), "requests": asked.total(), "requests_by_role": dict(asked),
        "scenes": len(scenes), "prompt_tokens": stats or None,
    }  # fmt: skip


def _fusion_calls(spec: Spec, helpers: int) -> int:
    """Return how many fusion calls a scene with so many helpers needs at most."""
    most: dict[Rewrites, int] = {}
    for point in spec.points:
        if point.has_fusion_call and point.asks:
            most[point.rewrites] = max(point.ask.max_helpers, most.get(point.rewrites, 0))
    return sum(
        comb(helpers, heard) * (2**heard if rewrites.attack else 1)
        for rewrites, others in most.items()
        for heard in range(1, min(others, helpers) + 1)
    )
