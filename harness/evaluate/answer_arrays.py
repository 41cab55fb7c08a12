"""Lay out answers as arrays of intents, with what their messages hold and how long they took."""

import math
from collections.abc import Sequence

import numpy as np

from harness.coordination.intents import Intents
from harness.core.files import canonical_bytes
from harness.dataset.load import Scene
from harness.evaluate.latency import inference_s
from harness.evaluate.spec import Spec
from harness.runs.records import Answer, Latency


def intents_of(
    spec: Spec,
    latency: Latency,
    scenes: Sequence[Scene],
    answers: Sequence[list[Answer | None]],
    width: int = 1,
) -> Intents:
    """Return what vehicles answered in n scenes as arrays, `(n, ...)`, of intents and their cost.

    An intent is the probabilities that a vehicle gives to the ego's actions. Arrays have room for
    `width` vehicles at least, the ego included; an answer that is missing or did not parse is a row
    of NaN.

    Args:
        spec: the evaluation, which says whose model answers for whom.
        latency: how long each answer took.
        scenes: the n decision points.
        answers: for each scene the ego's answer first, then the helpers' in order of
            `Scene.viewers`; None for one that was not asked yet.
        width: least number of vehicles.
    """
    width = max([width, *[len(row) for row in answers]])
    unknown = (math.nan,) * len(spec.actions)
    rows = [[*row, *[None] * (width - len(row))] for row in answers]
    models = [models_of(spec, scene, width) for scene in scenes]
    p, distances_m, ranges_m, bits, texts_b, unasked = [], [], [], [], [], []
    for scene, row, there in zip(scenes, rows, map(len, answers), strict=True):
        record, (ego, *helpers), absent = scene.record, scene.viewers, [math.nan] * (width - there)
        p.append([answer.intent or unknown if answer else unknown for answer in row])
        unasked.append([n < there and row[n] is None for n in range(1, width)])
        distances_m.append([record.distance_m[viewer] for viewer in (ego, *helpers)] + absent)
        ranges_m.append([record.range_m[viewer] for viewer in helpers] + absent)
        bits.append([_bits(scene, answer) for answer in row[1:]])
        texts_b.append([_text_bytes(answer) for answer in row[1:]])
    intents = np.array(p, dtype=float)
    valid = ~np.isnan(intents[:, 1:]).any(axis=-1)
    shape = len(scenes), width - 1
    not_yet = None if spec.asks_all else np.array(unasked, dtype=bool).reshape(shape)
    own_bits, own_text_bytes = None, None
    if any(point.needs("plans") for point in spec.points):
        ego_answers = [row[0] for row in rows]
        own_bits = np.array(list(map(_bits, scenes, ego_answers)), dtype=float)
        own_text_bytes = np.array(list(map(_text_bytes, ego_answers)), dtype=float)
    return Intents(
        intents[:, 0],
        intents[:, 1:],
        valid if not_yet is None else valid | not_yet,
        np.array(distances_m, dtype=float),
        np.array(ranges_m, dtype=float).reshape(shape),
        np.array(bits, dtype=float).reshape(shape),
        inference_s(latency, rows, models),
        unasked=not_yet,
        text_bytes=np.array(texts_b, dtype=float).reshape(shape),
        own_bits=own_bits,
        own_text_bytes=own_text_bytes,
    )


def models_of(spec: Spec, scene: Scene, width: int) -> list[int]:
    """Return for each vehicle in a scene the number of the model that answers for it.

    The order is that of `Scene.viewers`, the ego first. Number 0 is the ego's model; helpers count
    from 1, and those with models of their own take these in turn. If the scene has fewer than
    `width` vehicles, the list is filled up with their indices. `spec`, the evaluation, says whether
    helpers have models of their own.
    """
    there = range(len(scene.viewers))
    places = [scene.place(n) for n in there] if spec.helpers else [*there]
    return [*places, *range(len(places), width)]


def _text_bytes(answer: Answer | None) -> int:
    """Return the bytes of the words in a helper's message; 0 of a failed answer."""
    words = answer.message.get("evidence") if answer and answer.message else None
    return len(str(words or "").encode())


def _bits(scene: Scene, answer: Answer | None) -> int:
    """Return the bits of a message; 0 without an answer."""
    if answer is None:
        return 0
    sender = scene.state.vehicle(answer.viewer)
    return payload_bits((sender.x_m, sender.y_m), answer)


def payload_bits(xy_m: tuple[float, float], answer: Answer) -> int:
    """Return the size in bits of a helper's message as compact JSON.

    It holds the sender's id and position `xy_m` (m to the east and to the south, one decimal), and
    of its answer the intent (two decimals), evidence and risk.
    """
    intent = "null"
    if answer.intent:
        shares = [f"{share:.2f}" for share in answer.intent]
        intent = f"[{','.join([share[:-1] if share[-1] == '0' else share for share in shares])}]"
    numbers = f'{{"from":,"intent":{intent},"says":,"xy_m":[{xy_m[0]:.1f},{xy_m[1]:.1f}]}}'
    texts = canonical_bytes([answer.viewer, answer.message])
    return 8 * (len(numbers) + len(texts) - len("[,]"))
