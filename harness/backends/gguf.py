"""What a GGUF file states of itself: the keys and values before its weights.

The layout is that of https://github.com/ggml-org/ggml/blob/master/docs/gguf.md, versions 2 and 3.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.core.files import opened

# bytes of keys and values that are read: a vocabulary of 256 000 tokens needs a third
LONGEST = 1 << 26
_NUMBERS = {
    0: "B",
    1: "b",
    2: "H",
    3: "h",
    4: "I",
    5: "i",
    6: "f",
    7: "?",
    10: "Q",
    11: "q",
    12: "d",
}
SPECIALS = {"bos": "bos", "eos": "eos", "unk": "unknown", "pad": "padding"}
_TEXT, _ARRAY = 8, 9


@dataclass(frozen=True)
class ModelFacts:
    """Hold what a GGUF file, llama.cpp's format of weights, states of its model in its metadata.

    They are the model's `name` and `licence`, the longest sequence that it was trained for, the
    text of its chat `template`, and in `decision` the kind of decision model that it is (one that
    gives options probabilities and writes no text). A field is None where the file states nothing;
    nothing here is checked against the weights.
    """

    name: str | None = None  # the model's name
    licence: str | None = None  # SPDX id of its licence, or its name, as the file writes it
    context_tokens: int | None = None  # the longest sequence that it was trained for
    template: str | None = None  # its chat template
    # the kind of decision model that it is, such as `kev`; None if it is none
    decision: str | None = None


def read_facts(file: Path) -> ModelFacts:
    """Return what a GGUF file states of its model; all None if the file is no GGUF.

    Raises OSError if it cannot be opened.
    """
    try:
        values = read_metadata(file)
    except ValueError:
        return ModelFacts()

    def text(key: str) -> str | None:
        value = values.get(key)
        return value if isinstance(value, str) else None

    context = values.get(f"{values.get('general.architecture')}.context_length")
    context_tokens = context if isinstance(context, int) else None
    template = text("tokenizer.chat_template")
    decision = text(f"{values.get('general.architecture')}.decision.type")
    return ModelFacts(
        text("general.name"), text("general.license"), context_tokens, template, decision
    )


def read_metadata(file: Path, arrays: bool = False) -> Mapping[str, Any]:
    """Return the metadata keys and values of a GGUF file; arrays only with `arrays`.

    Raises OSError if it cannot be opened, and ValueError if it is no GGUF or they are longer than
    `LONGEST` bytes.
    """
    with opened(file, "weights") as data:
        head = data.read(LONGEST)
    magic, version, _, count = _unpacked("<4sIQQ", head, 0)
    if magic != b"GGUF" or version not in (2, 3):
        raise ValueError("no GGUF file of version 2 or 3")
    at = struct.calcsize("<4sIQQ")
    values: dict[str, Any] = {}
    for _ in range(count):
        key, at = _text(head, at)
        (kind,) = _unpacked("<I", head, at)
        value, at = _value(head, at + 4, kind, arrays)
        if value is not None:
            values[key] = value
    return values


def special_tokens(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts of a tokenizer's special tokens by their name, such as `bos_token`.

    `values` is the file's metadata, with arrays.
    """
    texts = values["tokenizer.ggml.tokens"]
    text_of: dict[str, str] = {}
    for name, key in SPECIALS.items():
        number = values.get(f"tokenizer.ggml.{key}_token_id")
        if number is not None:
            text_of[f"{name}_token"] = texts[number]
    return text_of


def _value(head: bytes, at: int, kind: int, arrays: bool) -> tuple[Any, int]:
    """Return a value and where the next begins; None for an array that is skipped."""
    if kind == _TEXT:
        return _text(head, at)
    if kind != _ARRAY:
        (number,) = _unpacked(f"<{_number(kind)}", head, at)
        return number, at + struct.calcsize(f"<{_number(kind)}")
    element, count = _unpacked("<IQ", head, at)
    at += 12
    if element == _TEXT:
        texts = []
        # each has eight bytes at least, so that a false count ends with the bytes
        for _ in range(count):
            if arrays:
                text, at = _text(head, at)
                texts.append(text)
            else:
                at += 8 + _unpacked("<Q", head, at)[0]
        return texts if arrays else None, at
    size = struct.calcsize(f"<{_number(element)}") * count
    if at + size > len(head):
        raise ValueError("an array is longer than the file")
    return list(
        struct.unpack_from(f"<{count}{_number(element)}", head, at)
    ) if arrays else None, at + size


def _text(head: bytes, at: int) -> tuple[str, int]:
    (length,) = _unpacked("<Q", head, at)
    at += 8
    if at + length > len(head):
        raise ValueError("a text is longer than the file")
    return head[at : at + length].decode(errors="replace"), at + length


def _number(kind: int) -> str:
    if kind not in _NUMBERS:
        raise ValueError(f"a value has the kind {kind}")
    return _NUMBERS[kind]


def _unpacked(form: str, head: bytes, at: int) -> tuple[Any, ...]:
    if at + struct.calcsize(form) > len(head):
        raise ValueError("it ends before its keys and values do")
    return struct.unpack_from(form, head, at)
