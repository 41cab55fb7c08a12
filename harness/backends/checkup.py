"""A look at a language model before any run: what it reads, token by token, and how fast it answers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from harness.backends.base import AnswerMode, Completion, Rendering, Request
from harness.backends.cards import Thinking
from harness.backends.chat import Chat
from harness.core.errors import UserError


@dataclass(frozen=True)
class Checkup:
    """What a look at a model shows.

    Attributes:
        prompt: the first question, just as the model reads it; as a server is sent it.
        tokens: its token ids, each with its text; None where only a server knows them.
        bos_tokens: how many of them begin a sequence; more than one harms most models.
        thinking: what the model's own template can do, whatever its card says; None where a server has it.
        answers: one answer an answer mode, asked alone after a warm-up; its seconds are batch-1 seconds.
        identity: as in a run's manifest.
    """

    prompt: str
    tokens: list[tuple[int, str]] | None
    bos_tokens: int | None
    thinking: Thinking | None
    answers: dict[AnswerMode, Completion]
    identity: dict[str, Any]


def check(backend: Rendering, asked: Sequence[Request]) -> Checkup:
    """Look at a model by some questions, one an answer mode."""
    [prompt] = backend.rendered(asked[:1])
    chat: Chat | None = getattr(backend, "chat", None)
    ids = chat.encode(prompt) if chat else []
    return Checkup(
        prompt=prompt,
        tokens=list(zip(ids, chat.pieces(ids), strict=True)) if chat else None,
        bos_tokens=ids.count(chat.bos) if chat and chat.bos is not None else (0 if chat else None),
        thinking=chat.thinking if chat else None,
        answers={request.answer: _answer(backend, request) for request in asked},
        identity=backend.identity(),
    )


def _answer(backend: Rendering, request: Request) -> Completion:
    try:
        # The first answer pays for kernels and caches. As in a run, its system prompt is the same and its
        # scene is another.
        *head, last = request.messages
        other = {**last, "content": f"Another scene. {last['content']}"}
        backend.complete([replace(request, messages=(*head, other))])
        [completion] = backend.complete([request])
    except UserError as error:  # the tokenizer or the server leaves no room for this answer mode
        return Completion(request.id, "", None, None, "error", None, 1, str(error))
    return completion
