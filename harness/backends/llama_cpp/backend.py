"""The backend of a GGUF file: llama.cpp in a child process."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.chat import Chat
from harness.backends.llama_cpp.child import Child
from harness.backends.weights import check_digest, find_gguf
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "LlamaBackend":
    """Find and load a card's weights."""
    if dtype not in (None, "auto"):
        raise UserError(f"dtype {printable(dtype)!r}; a GGUF file has its own: leave it out, or give auto")
    return LlamaBackend(card, check_digest(card, find_gguf(card)), device, batch_size)


class LlamaBackend(Child):
    """A GGUF file loaded in a child process."""

    def __init__(self, card: Card, file: Path, device: str | None, batch_size: int) -> None:
        self.batch_size = batch_size
        super().__init__(
            card.name, "harness.backends.llama_cpp.engine:open_here", card, file, device, batch_size
        )
        self.chat = Chat(card.name, _RemoteTokenizer(self), self.call("chat.image_token"), card.system)

    def next_log_probs(self, requests: Sequence[Request], vocabulary: int) -> Floats:
        log_p: Floats = self.call("next_log_probs", requests, vocabulary)
        return log_p


class _RemoteTokenizer:
    def __init__(self, child: Child) -> None:
        self._child = child
        stated = (
            child.call(f"chat.tokenizer.{name}") for name in ("template", "specials", "bos", "vocabulary")
        )
        self.template, self.specials, self.bos, self.vocabulary = stated

    def encode(self, text: str) -> list[int]:
        return list(self._call("encode", text))

    def decode(self, ids: Sequence[int]) -> str:
        return str(self._call("decode", ids))

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return list(self._call("pieces", ids))

    def candidates(self, letters: str) -> Sequence[int]:
        return range(self.vocabulary)

    def _call(self, attribute: str, *arguments: Any) -> Any:
        return self._child.call(f"chat.tokenizer.{attribute}", *arguments)
