"""What a number format brings on this processor: its pace, and how many prompts are read alike.
It advises, and decides nothing.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.registry import open_backend, registration
from harness.backends.transformers.engine import format_of_cpu
from harness.core.errors import Unanswered
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.extensions.checkups import questions
from harness.extensions.checkups.pace import PROMPT, TOKENS, is_small
from harness.prompts import versions

FORMATS = ("float32", "bfloat16")
BATCH = 8  # questions that are asked together, as a run asks them


@dataclass(frozen=True)
class FormatPace:
    """Hold how fast a model is on a CPU in one number format, and what it reads then.

    Tokens are those read and written. The fixed questions were asked in batches after one that
    warms up, on this machine.
    """

    dtype: str  # the number format
    readout_rate: float  # tokens a CPU second of read-outs (letters in one order)
    text_rate: float  # tokens a CPU second of the first `TOKENS` tokens of free answers
    actions: tuple[int | None, ...]  # place of each read-out's likeliest action; None: not read

    def alike(self, other: "FormatPace") -> int:
        """Return how many questions have the same likeliest action in both formats."""
        pairs = zip(self.actions, other.actions, strict=True)
        return sum(one is not None and one == another for one, another in pairs)


def format_paces(card: Card, device: object) -> list[FormatPace]:
    """Return how fast a model is in each number format, and what it reads.

    The list is empty unless a card's engine runs on the CPU, lets one choose the format, and the
    weights are small. `device` is where the model runs, as it states it. Raises UserError if
    weights do not load or the model cannot answer, and Unanswered if an answer fails.
    """
    chooses = "dtype" in registration(card.engine).allowed_keys
    if not chooses or device != "cpu" or card.vision or not is_small(card):
        return []
    return [_pace(card, dtype) for dtype in FORMATS]


def advice(measured: Sequence[FormatPace], taken: str, why: str) -> str:
    """Return a line that says how fast each number format is, what it changes and which is taken.

    `measured` has two formats, `taken` the name of the one that the card takes, and `why` the
    reason.
    """
    one, other = measured
    rates = [
        f"{each.dtype} {each.readout_rate:.0f} tokens a CPU second in read-outs and "
        f"{each.text_rate:.0f} in text"
        for each in measured
    ]
    return (
        f"{', '.join(rates)}; {one.alike(other)} of {len(one.actions)} prompts read alike; "
        f"{taken} is taken: {why}"
    )


def chosen_format(card: Card, typed: str | None) -> tuple[str, str]:
    """Return the number format that a card's model has on a CPU, and why.

    `typed` is the format that a user names instead of the card's; None takes the card's.
    """
    dtype = typed or card.dtype
    if dtype != "auto":
        return dtype, "it was typed" if typed else "its card says so"
    if card.engine == "transformers":
        return format_of_cpu()
    return dtype, f"{card.engine} chooses"


def _pace(card: Card, dtype: str) -> FormatPace:
    """Return how fast a model is in a number format, and what it reads. Raises Unanswered."""
    prompt = versions.load(PROMPT)
    reader = Agent(card, prompt, "readout", letters="raw")
    letters = questions.requests(reader)
    texts = [
        request.alike(max_tokens=TOKENS)
        for request in questions.requests(Agent(card, prompt, "json"))
    ]
    backend = open_backend(card, device="cpu", dtype=dtype, batch_size=BATCH)
    try:
        backend.complete(questions.requests(reader, "helper")[:1])
        readouts, readout_rate = _answers_and_rate(backend, letters)
        _, text_rate = _answers_and_rate(backend, texts)
    finally:
        getattr(backend, "close", lambda: None)()
    actions: list[int | None] = []
    for request, done in zip(letters, readouts, strict=True):
        intent = answer_of(request, done).intent
        actions.append(intent.index(max(intent)) if intent else None)
    return FormatPace(dtype, readout_rate, text_rate, tuple(actions))


def _answers_and_rate(
    backend: Backend, requests: Sequence[Request]
) -> tuple[list[Completion], float]:
    """Return the answers to some questions, and how many tokens they took a CPU second."""
    start_s = time.process_time()
    done = backend.complete(requests)
    cpu_s = max(time.process_time() - start_s, 1e-6)
    if errors := [answer.error for answer in done if answer.error is not None]:
        raise Unanswered(f"no answer to be timed: {errors[0]}")
    tokens = sum((answer.prompt_tokens or 0) + (answer.completion_tokens or 0) for answer in done)
    return done, tokens / cpu_s
