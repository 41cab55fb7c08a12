"""Count what an evaluation would ask, without a model."""

from collections import Counter
from itertools import chain
from pathlib import Path
from typing import Any

from harness.backends.tokens import counter, summarize_counts
from harness.dataset.load import Dataset
from harness.evaluate.asking import EGO, requests
from harness.evaluate.spec import Spec


def count(spec: Spec, dataset: Dataset, tokenizer: Path | None) -> dict[str, Any]:
    """Return the settings, how many requests would be asked about the scenes, and the tokens of prompts.

    Who asks a helper depends on answers: unless all are asked, helpers are asked as often at most.
    """
    tokens_of = counter(tokenizer, spec.ego.card)
    sizes: dict[str, list[int]] = {}
    asked, scenes = Counter[str](), dataset.scenes(dataset.courses())
    sighted = spec.asks_all or any(point.asks and not point.blind_helpers for point in spec.points)
    blind = any(point.blind_helpers and (spec.asks_all or point.asks) for point in spec.points)
    own = requests(spec, scenes, places=None if sighted else [EGO] * len(scenes))
    for request in chain(own, requests(spec, scenes, blind=True) if blind else ()):
        asked[request.role] += 1
        if tokens_of:
            vision = spec.agents[request.agent].card.vision if request.image else None
            tokens = tokens_of(request.messages) + (vision.tokens if vision else 0)
            sizes.setdefault(request.role, []).append(tokens)
    stats = {role: summarize_counts(n) for role, n in sizes.items()}
    return {
        **spec.settings(), "requests": asked.total(), "requests_by_role": dict(asked),
        "scenes": len(scenes), "prompt_tokens": stats or None,
    }  # fmt: skip
