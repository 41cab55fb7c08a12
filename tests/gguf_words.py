"""What a GGUF file says of text, for tests without one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass
class Words:
    """What a GGUF file says of text, its bytes as tokens."""

    template: str
    specials: Mapping[str, str] = field(default_factory=lambda: {"eos_token": "<|im_end|>"})
    bos: int | None = None
    vocabulary: int = 256

    def encode(self, text: str) -> list[int]:
        return list(text.encode())

    def decode(self, ids: Sequence[int]) -> str:
        return bytes(ids).decode()

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return [chr(byte) for byte in ids]

    def candidates(self, letters: str) -> Sequence[int]:
        return range(self.vocabulary)
