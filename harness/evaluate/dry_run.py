"""Count what an evaluation would ask, without a model."""

from collections import Counter
from collections.abc import Container, Iterator, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from harness.backends.base import Request
from harness.backends.tokens import counter, summarize_counts
from harness.coordination.operating_point import OperatingPoint, Rewrites
from harness.coordination.parts import PLAIN
from harness.dataset.load import Dataset, Scene
from harness.evaluate.fusion import codes_of, key_of
from harness.evaluate.requests import EGO, fusion_id, requests, stream_requests, stream_sets
from harness.evaluate.spec import Spec


def count(spec: Spec, dataset: Dataset, tokenizer: Path | None) -> dict[str, Any]:
    """Return how many requests an evaluation would make, and how long and dear its prompts are.

    The dict has the settings, `requests`, `requests_by_role`, `scenes`, `prompt_tokens` by role
    (None if no tokenizer is found) and, if a model has a price, `cost` by model, with answers as
    long as they may be; `streamed`, if helpers send unasked, how many of the requests each
    condition's stream adds. Tokens are counted by the file `tokenizer`; None takes that of the
    ego's model. Who asks a helper depends on answers, so numbers of helpers' requests and fusion
    calls are the most possible unless all are asked. `cost` has no fusion calls (second questions
    with the messages heard) and no repair turns (second questions after a failed answer).
    """
    tokens_of, costs = counter(tokenizer, spec.ego.card), dict[str, dict[str, Any]]()
    sizes: dict[str, list[int]] = {}
    requests_by_role, scenes = Counter[str](), dataset.scenes(dataset.courses())
    for request in planned(spec, scenes):
        requests_by_role[request.role] += 1
        card, tokens = spec.agents[request.agent].card, None
        if tokens_of:
            vision = card.vision if request.image else None
            tokens = tokens_of(request.messages) + (vision.tokens if vision else 0)
            sizes.setdefault(request.role, []).append(tokens)
        if card.price:
            times = 1 + len(request.orders) + len(request.flips)
            of = costs.setdefault(
                card.name, {"currency": card.price.currency, "prompts": 0.0, "answers": 0.0}
            )
            of["prompts"] = (
                None if tokens is None else of["prompts"] + card.price.of(times * tokens, 0)
            )
            of["answers"] += card.price.of(0, times * request.max_tokens)
    if calls := sum(1 for scene in scenes for _ in _fusion_calls(spec, scene)):
        requests_by_role["fusion"] = calls
    stats = {role: summarize_counts(n) for role, n in sizes.items()}
    counts = {
        **spec.record(),
        "requests": requests_by_role.total(),
        "requests_by_role": dict(requests_by_role),
        "scenes": len(scenes),
        "prompt_tokens": stats or None,
    }
    if unasked := streamed(spec, scenes):
        counts["streamed"] = unasked
    return {**counts, "cost": costs} if costs else counts


def planned(spec: Spec, scenes: Sequence[Scene]) -> Iterator[Request]:
    """Yield the requests that an evaluation makes in some scenes at most, without fusion calls.

    A fusion call is a second question to the ego's model, with the messages that it heard.
    """
    intents = [point for point in spec.points if point.asks and point.content.asks_helpers]
    plain = spec.asks_all or any(point.question == PLAIN for point in intents)
    yield from requests(spec, scenes, places=None if plain else [EGO] * len(scenes))
    asking = spec.points if spec.asks_all else intents
    for question in {point.question for point in asking if point.question != PLAIN}:
        yield from requests(spec, scenes, question)
    yield from stream_requests(spec, scenes, list(_stream_questions(spec, scenes).values()))


def _stream_questions(spec: Spec, scenes: Sequence[Scene]) -> dict[str, tuple[Scene, list[str]]]:
    """Return what egos have heard unasked, as `stream_sets`, by the id of the question."""
    sets = {}
    for point in spec.points:
        for scene, senders in _unasked(spec, scenes, point):
            if senders:
                sets[fusion_id(scene, senders)] = scene, senders
    return sets


def streamed(spec: Spec, scenes: Sequence[Scene]) -> dict[str, int]:
    """Return how many questions the stream of each condition adds in some scenes, by condition.

    A stream is what helpers send unasked; conditions with equal streams share their questions.
    """
    counts = {}
    for point in spec.points:
        if point.stream:
            sets = _unasked(spec, scenes, point)
            counts[point.name] = sum(bool(senders) for _, senders in sets)
    return counts


def _unasked(
    spec: Spec, scenes: Sequence[Scene], point: OperatingPoint
) -> list[tuple[Scene, list[str]]]:
    """Return each scene with the keys of what its ego has heard unasked, if anything.

    Each has one question, whoever attacks and whatever layout is heard: here all helpers, and the
    next scene's.
    """
    if not point.stream:
        return []
    n, helpers = len(scenes), max(len(scene.viewers) for scene in scenes) - 1
    rewrites, at = point.rewrites, np.arange(n)
    places = at * n + np.roll(at, -1) if rewrites.elsewhere else at
    attacks = np.ones((n, helpers if rewrites.changes.of_attackers else 0), dtype=bool)
    codes = codes_of(attacks, places)
    return stream_sets(spec.scenario, scenes, point.stream, codes, rewrites)


def lacking(
    spec: Spec, dataset: Dataset, scenes: Sequence[str], answers: Container[str]
) -> dict[str, int]:
    """Return how many questions about some scenes have no answer yet, by role.

    It is asked before a stored run is scored again. `scenes` are ids of scenes of the dataset,
    `answers` the ids of requests that have one; a role is who is asked, such as `helper`. All
    questions count that any condition may ask there, whoever is heard. A condition is a named set
    of settings of the radio, of asking helpers and of fusing their messages.
    """
    lacks, sends = (
        Counter[str](),
        any(point.asks and point.content.asks_helpers for point in spec.points),
    )
    asked_about = dataset.scenes(scenes)
    lacks["ego"] += sum(name not in answers for name in _stream_questions(spec, asked_about))
    for scene in asked_about:
        viewers = spec.viewers(scene)
        viewers_by_role = {"ego": viewers[:1], "helper": viewers[1:] if sends else ()}
        for role, those in viewers_by_role.items():
            lacks[role] += sum(f"{scene.id}/{viewer}" not in answers for viewer in those)
        lacks["fusion"] += sum(name not in answers for name in _fusion_calls(spec, scene))
    return dict(lacks)


def _fusion_calls(spec: Spec, scene: Scene) -> Iterator[str]:
    """Yield the ids of the fusion calls that a scene needs at most.

    Where messages come from elsewhere, each condition and seed may hear another layout,
    whose id stands open.
    """
    most, sources = dict[Rewrites, int](), dict[Rewrites, list[str]]()
    for point in spec.points:
        if point.has_fusion_call and point.asks:
            rewrites = point.rewrites
            most[rewrites] = max(point.ask.max_helpers, most.get(rewrites, 0))
            open_ids = [f"{point.name}-{seed}" for seed in spec.seeds]
            sources[rewrites] = (
                [*sources.get(rewrites, ()), *open_ids] if rewrites.elsewhere else [""]
            )
    helpers = scene.viewers[1:]
    for rewrites, others in most.items():
        attacking = (False, True) if rewrites.changes.of_attackers else (False,)
        for n in range(1, min(others, len(helpers)) + 1):
            for heard in combinations(helpers, n):
                for attacks in product(attacking, repeat=n):
                    those = list(zip(heard, attacks, strict=True))
                    for source in sources[rewrites]:
                        yield fusion_id(
                            scene, [key_of(helper, rewrites, a, source) for helper, a in those]
                        )
