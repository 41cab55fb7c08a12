"""From answers to arrays: intents of every viewer of every scene, and what a message costs on air."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.coordination.intents import Intents
from harness.core.files import canonical_json
from harness.dataset.load import Dataset
from harness.evaluate.asking import Answer
from harness.parsing.parse import Parsed, parse


@dataclass(frozen=True)
class Answered(Intents):
    """What every viewer of every scene intends, (n, ...), with the answers that say so.

    Attributes:
        answers: raw answers, n lists of 1+H; None where nobody was asked.
        parsed: what each says, in the same places.
    """

    answers: list[list[Answer | None]]
    parsed: list[list[Parsed | None]]


def intents(dataset: Dataset, by_id: Mapping[str, Answer], answer: str, thinking: bool) -> Answered:
    """Parse every answer. A failed one is NaN and keeps its status. `inference_s` is unknown as yet: NaN.

    Args:
        dataset: the scenes.
        by_id: answers by request id.
        answer: the answer mode that they were given in.
        thinking: whether the model was asked to think first.
    """
    scenes, actions = dataset.scenes, dataset.actions

    def parsed_of(a: Answer, role: str) -> Parsed:
        # A read-out is a bare distribution, whoever gives it.
        asked_as = "ego" if answer == "readout" else role
        return parse(
            a["raw"], role=asked_as, actions=actions, thinking=thinking,
            finish_reason=a["finish_reason"], error=a["error"],
        )  # fmt: skip

    width = max(len(scene.viewers) for scene in scenes)
    answers = [_padded([by_id.get(f"{s.id}/{v}") for v in s.viewers], width) for s in scenes]
    parsed = [
        [parsed_of(a, "ego" if j == 0 else "helper") if a else None for j, a in enumerate(row)]
        for row in answers
    ]
    p = np.full((len(scenes), width, len(actions)), np.nan)
    distance, reach = np.full((len(scenes), width), np.nan), np.full((len(scenes), width - 1), np.nan)
    bits = np.zeros((len(scenes), width - 1))
    for i, scene in enumerate(scenes):
        at = {v["id"]: (v["x_m"], v["y_m"]) for v in scene.record["state"]["vehicles"]}
        for j, viewer in enumerate(scene.viewers):
            distance[i, j] = scene.record["distance_m"][viewer]
            said = parsed[i][j]
            if said and said.intent is not None:
                p[i, j] = said.intent
            if j == 0:
                ego_x_m, ego_y_m = at[viewer]
            else:
                x_m, y_m = at[viewer]
                reach[i, j - 1] = np.hypot(x_m - ego_x_m, y_m - ego_y_m)
                bits[i, j - 1] = payload_bits(viewer, at[viewer], said) if said else 0
    valid = ~np.isnan(p[:, 1:]).any(axis=-1)
    return Answered(
        p[:, 0], p[:, 1:], valid, distance, reach, bits, np.full(distance.shape, np.nan), answers, parsed
    )


def payload_bits(viewer: str, xy_m: tuple[float, float], said: Parsed) -> int:
    """Size of the message a helper sends: its id, position, intent, evidence and risk, as compact JSON."""
    message = {
        "from": viewer,
        "xy_m": [round(x, 1) for x in xy_m],
        "intent": said.intent and [round(x, 2) for x in said.intent],
        "says": said.message,
    }
    return 8 * len(canonical_json(message).encode())


def _padded(row: list[Answer | None], width: int) -> list[Answer | None]:
    return row + [None] * (width - len(row))
