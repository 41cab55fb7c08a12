"""The backend of language models that run in this process, on any engine:
batching, overflow and errors.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple

from harness.backends.base import Completion, Request, failed
from harness.backends.decoding import Decoding
from harness.backends.engine import Engine, common_length
from harness.core.arrays import Floats
from harness.core.errors import UserError, one_line


class _Prompt(NamedTuple):
    position: int  # among the requests
    request: Request
    orders: list[list[int]]  # its tokens; of a read-out, with each order of the actions

    @property
    def read(self) -> int:
        """Number of tokens that are read: what all orders begin with counts once."""
        shared = common_length(self.orders)
        return shared + sum(len(ids) - shared for ids in self.orders)


class LanguageModel:
    """Answer requests by a language model in this process, in batches of at most `batch_size`."""

    def __init__(self, engine: Engine, batch_size: int) -> None:
        self.engine = engine
        self.chat = engine.chat
        self.batch_size = batch_size
        self._decoding = Decoding(engine)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Return one completion per request, in the same order.

        `completion_tokens` counts all written tokens, with the stop token and fixed tokens and
        without padding. If a batch fails, its requests are asked again one at a time. Raises
        UserError if the tokenizer or `max_tokens` leaves no room for the answer mode, or the
        template refuses the messages.
        """
        done: dict[int, Completion] = {}
        fitting = []
        for position, request in enumerate(requests):
            rotations = (request.alike(messages=messages) for messages in request.orders)
            orders = [self.tokens(each) for each in (request, *rotations)]
            longest, room = max(map(len, orders)), self._decoding.room(request)
            if longest + room > (most := self.engine.context_tokens):
                parts = f"({longest} in the prompt, {room} for the answer)"
                error = f"context overflow: {longest + room} tokens > {most} {parts}"
                done[position] = failed(request, error, longest)
            else:
                fitting.append(_Prompt(position, request, orders))
        for batch in self._batches(fitting):
            for prompt, completion in zip(batch, self._answer(batch), strict=True):
                done[prompt.position] = completion
        return [done[position] for position in range(len(requests))]

    def tokens(self, request: Request) -> list[int]:
        text = self.chat.render(request.messages, thinking=request.thinking)
        if request.image is None:
            return self.chat.encode(text)
        before, *after = text.split(self.chat.image_token) if self.chat.image_token else [text]
        if len(after) != 1:
            raise UserError(
                f"{self.chat.subject}: its chat template writes {len(after)} places for one "
                "picture; give a model that takes pictures, with the template that it was trained "
                "with"
            )
        return [
            *self.chat.encode(before),
            *self.engine.look(request.image),
            *self.chat.encode(after[0]),
        ]

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        return [self.chat.render(r.messages, thinking=r.thinking) for r in requests]

    def next_log_probs(self, requests: Sequence[Request], vocabulary: int) -> Floats:
        """Return log-probabilities of the first token after each of n prompts, `(n, V)`.

        They are what training compares a model by. The prompts are those of the requests, and V is
        `vocabulary`: the values are of the token ids 0 to V - 1.
        """
        with closing(self.engine.begin([self.tokens(request) for request in requests])) as session:
            return session.log_probs(range(vocabulary))

    def forget(self) -> None:
        self.engine.forget()

    def identity(self) -> dict[str, Any]:
        return self.engine.identity()

    def _batches(self, prompts: list[_Prompt]) -> Iterator[list[_Prompt]]:
        """Yield batches of prompts that have one answer mode,
        similar beginnings and similar lengths.

        Prompts of one role begin alike, since they have the same system prompt.
        """

        def kind(p: _Prompt) -> tuple[str, int, str, int, int]:
            return (
                p.request.answer,
                len(p.orders),
                p.request.role,
                p.request.max_tokens,
                len(p.orders[0]),
            )

        for _, group in groupby(sorted(prompts, key=kind, reverse=True), lambda p: kind(p)[:2]):
            same_mode = list(group)
            for start in range(0, len(same_mode), self.batch_size):
                yield same_mode[start : start + self.batch_size]

    def _answer(self, batch: list[_Prompt]) -> list[Completion]:
        answers = self._try(batch)
        if isinstance(answers, list):
            return answers
        # `_try` has returned, so nothing refers to the failed batch and an engine can free its
        # memory.
        alone = [self._try([prompt]) for prompt in batch]
        return [
            a[0] if isinstance(a, list) else failed(p.request, a, len(p.orders[0]))
            for p, a in zip(batch, alone, strict=True)
        ]

    def _try(self, batch: list[_Prompt]) -> list[Completion] | str:
        """Return the completions of a batch, or the engine's error message."""
        try:
            answers = self._decoding.answer([p.request for p in batch], [p.orders for p in batch])
        except Exception as error:  # an engine may fail in any way; its message is data
            return f"{type(error).__name__}: {one_line(error)}"
        return [
            replace(answer, prompt_tokens=p.read) for p, answer in zip(batch, answers, strict=True)
        ]
