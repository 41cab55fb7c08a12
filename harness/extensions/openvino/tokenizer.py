"""The tokenizer of a GGUF file for prompts and answers, without OpenVINO's or transformers'."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.backends.gguf import read_metadata, special_tokens
from harness.backends.tokens import token_ids, tokenizer
from harness.core.errors import UserError

_ENDS = ("eos", "eot", "eom")  # tokens that end an answer, as the file names them
_LONGEST = 8  # characters of a letter's longest token: `<0x41>`, or a letter with blanks


class GgufTokenizer:
    """Turn texts into token ids and back by the vocabulary that a GGUF file states.

    It is a `Tokenizer` of `harness.backends.chat`, the one with which transformers reads the same
    file. `ends` are the ids of the tokens that end an answer, and `context_tokens` the longest
    sequence that the model was trained for.
    """

    def __init__(self, file: Path, subject: str) -> None:
        """Read the tokenizer of a file; `subject` names it in messages.

        Raises UserError if it has none, or no chat template.
        """
        values = read_metadata(file, arrays=True)
        template = values.get("tokenizer.chat_template")
        if not isinstance(template, str):
            raise UserError(
                f"{subject} has no chat template; give the GGUF file of its instruct version"
            )
        self.template = template
        self.context_tokens = int(values[f"{values['general.architecture']}.context_length"])
        self._loaded = tokenizer(file)
        self.vocabulary: int = self._loaded.get_vocab_size()
        self.specials: Mapping[str, str] = special_tokens(values)
        self.bos = _id(values, "bos")
        numbers = [_id(values, name) for name in _ENDS]
        self.ends = [number for number in numbers if number is not None]

    def encode(self, text: str) -> list[int]:
        return token_ids(self._loaded, text)

    def decode(self, ids: Sequence[int]) -> str:
        text: str = self._loaded.decode(list(ids), skip_special_tokens=True)
        return text

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return [self._loaded.decode([token], skip_special_tokens=False) for token in ids]

    def candidates(self, letters: str) -> Sequence[int]:
        wanted = set(letters)
        short = [(text, n) for text, n in self._loaded.get_vocab().items() if len(text) <= _LONGEST]
        return [n for text, n in short if text.startswith("<0x") or not wanted.isdisjoint(text)]


def _id(values: Mapping[str, Any], name: str) -> int | None:
    number = values.get(f"tokenizer.ggml.{name}_token_id")
    return number if isinstance(number, int) else None
