"""The backend of every language model that runs in this process, whatever its engine."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from harness.backends.base import Completion, Request
from harness.backends.transformers_engine import TransformersEngine
from harness.errors import printable


class _Prompt(NamedTuple):
    """One request as the engine sees it."""

    position: int
    request: Request
    ids: list[int]


class LanguageModel:
    """An engine that is asked in batches.

    Attributes:
        engine: the loaded model.
        chat: its tokenizer and chat template.
        batch_size: most requests that go through the engine together.
    """

    def __init__(self, engine: TransformersEngine, batch_size: int) -> None:
        self.engine = engine
        self.chat = engine.chat
        self.batch_size = batch_size

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order.

        `completion_tokens` counts what was generated, the stop token included, padding not. Requests of
        like length share a batch. A batch that fails is asked again, one request at a time.
        """
        done: dict[int, Completion] = {}
        fitting = []
        for position, request in enumerate(requests):
            ids = self.chat.encode(self.chat.render(request.messages, thinking=request.thinking))
            if len(ids) + request.max_tokens > self.engine.context_tokens:
                done[position] = _failed(request, len(ids), self._overflow(len(ids), request.max_tokens))
            else:
                fitting.append(_Prompt(position, request, ids))
        fitting.sort(key=lambda p: (p.request.max_tokens, len(p.ids)), reverse=True)
        for start in range(0, len(fitting), self.batch_size):
            batch = fitting[start : start + self.batch_size]
            for prompt, completion in zip(batch, self._answer(batch), strict=True):
                done[prompt.position] = completion
        return [done[position] for position in range(len(requests))]

    def identity(self) -> dict[str, Any]:
        """What decides the answers: the engine's."""
        return self.engine.identity()

    def _overflow(self, prompt_tokens: int, max_tokens: int) -> str:
        return (
            f"context overflow: {prompt_tokens + max_tokens} tokens > {self.engine.context_tokens} "
            f"({prompt_tokens} in the prompt, {max_tokens} for the answer)"
        )

    def _answer(self, batch: list[_Prompt]) -> list[Completion]:
        answered = self._try(batch)
        if isinstance(answered, list):
            return answered
        # Out here the failed batch's tensors are gone, so the retry has the whole memory.
        self.engine.free()
        completions = []
        for prompt in batch:
            alone = self._try([prompt])
            if isinstance(alone, list):
                completions += alone
            else:
                completions.append(_failed(prompt.request, len(prompt.ids), alone))
                self.engine.free()
        return completions

    def _try(self, batch: list[_Prompt]) -> list[Completion] | str:
        """Completions of a batch, or the engine's message."""
        try:
            start_s = time.perf_counter()
            generated = self.engine.generate([p.ids for p in batch], max(p.request.max_tokens for p in batch))
            seconds = time.perf_counter() - start_s
        except Exception as error:  # an engine may fail in any way; what it says is data
            return f"{type(error).__name__}: {printable(' '.join(str(error).split()), 200)}"
        alone = seconds if len(batch) == 1 else None
        return [
            self._completion(p, tokens, alone, len(batch)) for p, tokens in zip(batch, generated, strict=True)
        ]

    def _completion(
        self, prompt: _Prompt, tokens: list[int], seconds: float | None, batch_size: int
    ) -> Completion:
        tokens = tokens[: prompt.request.max_tokens]
        end = next((i for i, token in enumerate(tokens) if token in self.engine.stops), None)
        return Completion(
            request_id=prompt.request.id,
            text=self.chat.decode(tokens[:end]),
            prompt_tokens=len(prompt.ids),
            completion_tokens=len(tokens) if end is None else end + 1,
            finish_reason="length" if end is None else "stop",
            seconds=seconds,
            batch_size=batch_size,
        )


def _failed(request: Request, prompt_tokens: int, error: str) -> Completion:
    return Completion(request.id, "", prompt_tokens, None, "error", None, 1, error)
