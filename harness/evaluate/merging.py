"""`ego-prompt`: the ego's model merges the messages that arrived with its own view, and answers again.

Who is heard depends on the channel and not on fusion, so all sets of messages that any operating point and
seed delivers are known before the first of them is asked. Each is asked once.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.backends.base import Request
from harness.coordination.exchange import Luck, exchange
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.load import Scene
from harness.evaluate.asking import Answer, most_tokens
from harness.evaluate.intents import Intents
from harness.evaluate.spec import Spec
from harness.parsing.parse import Parsed, parse


@dataclass(frozen=True)
class Merged:
    """The ego's second answers: K of them, H helpers, A actions. Calling it is what `coordinate` wants.

    Attributes:
        codes: decision and who was heard in it (`codes_of`), ascending, (K,).
        answers: raw answers.
        parsed: what each says.
        intents: (K, A); NaN where the answer failed.
        seconds: time of each second inference, (K,).
    """

    codes: Ints
    answers: Sequence[Answer]
    parsed: Sequence[Parsed]
    intents: Floats
    seconds: Floats

    def __call__(self, on_time: Bools, at: Ints | None = None) -> tuple[Floats, Floats]:
        """Intents (n, A) and seconds (n,) for who was heard, (n, H); NaN where nobody was.

        `at` (n,) says which decision each is of; None where they are the decisions in order.
        """
        anybody = on_time.any(axis=1)
        wanted = codes_of(on_time, at)[anybody]
        place = np.searchsorted(self.codes, wanted)
        if not np.array_equal(self.codes[np.minimum(place, len(self.codes) - 1)], wanted):
            raise LookupError("a set of messages was delivered that the ego's model was never asked about")
        intents = np.full((len(on_time), self.intents.shape[1]), np.nan)
        seconds = np.full(len(on_time), np.nan)
        intents[anybody], seconds[anybody] = self.intents[place], self.seconds[place]
        return intents, seconds


def codes_of(on_time: Bools, at: Ints | None = None) -> Ints:
    """One number for a decision and who was heard in it, (n,), from (n, H); `at` as in `Merged`."""
    n, helpers = on_time.shape
    at = np.arange(n) if at is None else at
    return np.asarray(at << helpers | on_time @ (1 << np.arange(helpers)))


def places_of(code: int, helpers: int) -> list[int]:
    """Places among a scene's viewers of the helpers that were heard."""
    return [1 + h for h in range(helpers) if code >> h & 1]


def delivered(
    known: Intents, inference_s: Floats, points: Iterable[OperatingPoint], lucks: Iterable[Luck]
) -> Ints:
    """Codes of all sets of messages that points delivered where the ego's model is asked again, ascending."""
    found: Ints = np.empty(0, dtype=int)
    lucks = list(lucks)
    for point in points:
        for luck in lucks if point.asks_again else ():
            heard = exchange(
                point, known.own, known.helpers, known.valid, known.range_m, known.payload_bits,
                np.nan_to_num(inference_s), luck,
            ).on_time  # fmt: skip
            found = np.union1d(found, codes_of(heard)[heard.any(axis=1)])
    return found


def requests(spec: Spec, known: Intents, codes: Ints) -> Iterator[Request]:
    """What the ego's model is asked the second time, one request a code."""
    helpers = known.valid.shape[1]
    for code in codes.tolist():
        i, places = code >> helpers, places_of(code, helpers)
        scene = spec.dataset.scenes[i]
        graph, sent = scene.record["graphs"][scene.viewers[0]], messages(scene, known.parsed[i], places)
        yield Request(
            id=request_id(scene, places),
            role="ego",
            messages=spec.prompt.render(graph, spec.dataset.actions, sent, spec.dataset.scenario.words),
            actions=spec.dataset.actions,
            max_tokens=most_tokens(spec, "ego"),
            form=spec.prompt.helper_answer,
            answer=spec.answer,
            thinking=spec.thinking,
        )


def request_id(scene: Scene, places: Sequence[int]) -> str:
    """The scene, the ego, and whose messages it has."""
    return f"{scene.id}/{'+'.join(scene.viewers[place] for place in (0, *places))}"


def messages(scene: Scene, parsed: Sequence[Parsed | None], places: Sequence[int]) -> list[dict[str, Any]]:
    """What the helpers at these places sent, as a prompt takes it."""
    sent = []
    for place in places:
        said = parsed[place]
        if said and said.intent and said.message:  # as all have that are heard
            sent.append({"sender": scene.viewers[place], "intent": list(said.intent), **said.message})
    return sent


def merged(spec: Spec, codes: Ints, answers: Sequence[Answer], seconds: Floats) -> Merged:
    """Parse the second answers, in the order of their codes. A failed one is NaN and keeps its status."""
    parsed = [
        parse(
            a["raw"], role="ego", actions=spec.dataset.actions, thinking=spec.thinking,
            finish_reason=a["finish_reason"], error=a["error"],
        )
        for a in answers
    ]  # fmt: skip
    nothing = [np.nan] * len(spec.dataset.actions)
    intents = np.array([p.intent or nothing for p in parsed]).reshape(len(parsed), len(nothing))
    return Merged(codes, answers, parsed, intents, seconds)
