"""Count the tokens of prompts with a model's own tokenizer, without loading the model."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.backends.cards import Card
from harness.core.errors import UserError, printable
from harness.core.files import text_of
from harness.core.resources import find

# Qwen2's pre-tokeniser, for `tokenizer.ggml.pre = qwen2`: every digit is a piece of its own.
QWEN2_SPLIT = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}"
    r"| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)


@lru_cache(maxsize=4)
def tokenizer(source: Path) -> Any:
    """Load a `tokenizers.Tokenizer` from a GGUF file (Qwen2 kind), a tokenizer.json, or a folder with one.

    A file may have been saved with a longest length or with padding; both are switched off.

    Raises:
        UserError: there is no tokenizer, or it is of another kind.
    """
    from tokenizers import Tokenizer

    file = source / "tokenizer.json" if source.is_dir() else source
    if not file.is_file():
        raise UserError(
            f"no tokenizer at {printable(file)}; give a tokenizer.json, its folder, or a GGUF file"
        )
    try:
        return (
            _from_gguf(file) if file.suffix == ".gguf" else whole(Tokenizer.from_str(text_of(file, "record")))
        )
    except UserError:
        raise
    except Exception as error:  # tokenizers and gguf raise bare Exceptions on a broken file
        raise UserError(f"{printable(file)} is no readable tokenizer: {printable(error)}") from None


def whole(loaded: Any) -> Any:
    """Let a `tokenizers.Tokenizer` neither cut texts off nor pad them, and return it."""
    loaded.no_truncation()
    loaded.no_padding()
    return loaded


def token_ids(loaded: Any, text: str) -> list[int]:
    """Return the token ids of a text in a chat, without those that a tokenizer puts around a whole prompt."""
    encoded: list[int] = loaded.encode(text, add_special_tokens=False).ids
    return encoded


def _from_gguf(file: Path) -> Any:
    from gguf import GGUFReader
    from tokenizers import AddedToken, models

    reader = GGUFReader(file)

    def texts(key: str) -> list[str]:
        field = reader.fields[key]
        return [bytes(field.parts[i]).decode("utf-8") for i in field.data]

    (kind,) = texts("tokenizer.ggml.pre")
    if kind != "qwen2":
        raise UserError(f"{printable(file)} has the pre-tokeniser {printable(kind)}; only qwen2 can be read")
    vocabulary = texts("tokenizer.ggml.tokens")
    merges = [(left, right) for left, right in (p.split(" ") for p in texts("tokenizer.ggml.merges"))]
    types = [int(reader.fields["tokenizer.ggml.token_type"].parts[i][0])
             for i in reader.fields["tokenizer.ggml.token_type"].data]  # fmt: skip
    built = byte_level(models.BPE(vocab={t: i for i, t in enumerate(vocabulary)}, merges=merges))
    # Control tokens, and user-defined tokens that are never split, such as `<think>`.
    added = [(t, k) for t, k in zip(vocabulary, types, strict=True) if k in (3, 4)]
    built.add_tokens([AddedToken(t, special=k == 3, normalized=False) for t, k in added])
    return built


def byte_level(model: Any) -> Any:
    """Build a `tokenizers.Tokenizer` of a byte-level BPE model that splits text as Qwen2 does."""
    from tokenizers import Regex, Tokenizer, decoders, pre_tokenizers

    built = Tokenizer(model)
    built.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(QWEN2_SPLIT), "isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    built.decoder = decoders.ByteLevel()
    return built


def counter(
    source: Path | None, card: Card | None = None
) -> Callable[[Iterable[Mapping[str, str]]], int] | None:
    """Return a function that counts the tokens of chat messages, without those of the chat template.

    It uses the given tokenizer, or else the one beside the model's weights; None if there is neither.
    """
    if source is None and card and card.weights:
        beside = find("models", card.weights)
        source = beside if (beside / "tokenizer.json").is_file() else None
    if source is None:
        return None
    loaded = tokenizer(source)
    return lambda messages: sum(len(token_ids(loaded, m["content"])) for m in messages)


def spread_of(counts: Sequence[int]) -> dict[str, float]:
    """Return `n`, `least`, `mean` and `most` of some token counts."""
    mean = round(sum(counts) / len(counts), 1)
    return {"n": len(counts), "least": min(counts), "mean": mean, "most": max(counts)}
