"""The backend of a GGUF file: llama.cpp in a child process."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.chat import Chat
from harness.backends.llama_cpp.child import Child
from harness.backends.weights import find_gguf, held_to_digest
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "LlamaBackend":
    """Find and load a card's weights.

    Raises:
        UserError: the file is missing, an option is wrong, or llama.cpp refuses the file.
    """
    if dtype not in (None, "auto"):
        raise UserError(f"dtype {printable(dtype)!r}; a GGUF file has its own: leave it out, or give auto")
    return LlamaBackend(card, held_to_digest(card, find_gguf(card)), device, batch_size)


class LlamaBackend(Child):
    """A GGUF file loaded in a child process.

    Attributes:
        chat: its tokenizer and chat template.
        batch_size: most requests that go through the engine together.
    """

    def __init__(self, card: Card, file: Path, device: str | None, batch_size: int) -> None:
        self.batch_size = batch_size
        super().__init__(
            card.name, "harness.backends.llama_cpp.engine:open_here", card, file, device, batch_size
        )
        self.chat = _RemoteChat(card.name, self)

    def next_log_probs(self, requests: Sequence[Request], vocabulary: int) -> Floats:
        """Return the natural log-probabilities of the first `vocabulary` tokens after each prompt.

        Shape (n, vocabulary).
        """
        log_p: Floats = self.call("next_log_probs", requests, vocabulary)
        return log_p


def _of_child(attribute: str) -> Any:
    """Return a method that calls the chat's method in the child."""

    def method(chat: "_RemoteChat", *arguments: Any, **options: Any) -> Any:
        return chat.child.call(f"chat.{attribute}", *arguments, **options)

    return method


class _RemoteChat(Chat):
    """A chat template and tokenizer in the child process."""

    def __init__(self, name: str, child: Child) -> None:
        self.name = name
        self.template = child.call("chat.template")
        self.image_token = child.call("chat.image_token")
        self.child = child

    bos = property(_of_child("bos"))
    turn_end = property(_of_child("turn_end"))
    render, encode, decode, pieces = map(_of_child, ("render", "encode", "decode", "pieces"))
