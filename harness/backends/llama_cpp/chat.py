"""The chat template of a GGUF file, with llama.cpp's own tokenizer."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from harness.backends.chat import Chat


class Vocabulary(Protocol):
    """The tokenizer of a GGUF file; `harness.backends.llama_cpp.model.LlamaModel` is one."""

    template: str
    specials: dict[str, str]
    bos: int | None
    vocabulary: int

    def encode(self, text: str) -> list[int]: ...
    def decode(self, ids: Sequence[int]) -> str: ...
    def pieces(self, ids: Sequence[int]) -> list[str]: ...


class GgufChat(Chat):
    """A GGUF file's tokenizer and chat template."""

    def __init__(
        self, name: str, vocabulary: Vocabulary, image_token: str | None = None, system: str | None = None
    ) -> None:
        self._vocabulary = vocabulary
        self._begin(name, vocabulary.template, image_token, system)

    @property
    def specials(self) -> Mapping[str, str]:
        return self._vocabulary.specials

    @property
    def bos(self) -> int | None:
        return self._vocabulary.bos

    def encode(self, prompt: str) -> list[int]:
        return self._vocabulary.encode(prompt)

    def decode(self, ids: Sequence[int]) -> str:
        return self._vocabulary.decode(ids)

    @property
    def vocabulary(self) -> int:
        return self._vocabulary.vocabulary

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return self._vocabulary.pieces(ids)

    def _candidates(self, letters: str) -> Sequence[int]:
        return range(self.vocabulary)
