"""Count the tokens of prompts with a model's own tokenizer, without loading the model."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.backends.card import Card
from harness.backends.gguf import read_metadata
from harness.backends.weights import find_gguf, is_gguf
from harness.core.errors import UserError, printable
from harness.core.extras import OPTIONAL, without
from harness.core.files import text_of
from harness.core.resources import find

# Qwen2's pre-tokeniser, for `tokenizer.ggml.pre = qwen2`: every digit is a piece of its own.
QWEN2_SPLIT = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}"
    r"| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
_GPT2_SPLIT = r"'s|'t|'re|'ve|'m|'ll|'d| ?\p{L}+| ?\p{N}+| ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+"
# How byte-level vocabularies split text before they merge bytes, one pattern after another, by
# `tokenizer.ggml.pre`: as llama.cpp does by that name.
_SPLITS: Mapping[str, tuple[str, ...]] = {
    "qwen2": (QWEN2_SPLIT,),
    "gpt-2": (_GPT2_SPLIT,),
    **dict.fromkeys(("smollm", "starcoder", "refact", "command-r"), (r"\p{N}", _GPT2_SPLIT)),
    "llama-bpe": (QWEN2_SPLIT.replace(r"|\p{N}|", r"|\p{N}{1,3}|"),),
}
_WHOLE_FIRST = ("llama-bpe",)  # a piece that is a token is not merged out of its bytes
_CONTROL, _USER_DEFINED = 3, 4  # types of a GGUF file's tokens


@lru_cache(maxsize=4)
def tokenizer(source: Path) -> Any:
    """Return a `tokenizers.Tokenizer` from a GGUF file, a tokenizer.json, or a folder with one.

    It neither cuts texts off nor pads them, whatever the file says. Raises UserError if there is
    none.
    """
    from tokenizers import Tokenizer

    file = source / "tokenizer.json" if source.is_dir() else source
    if not file.is_file():
        raise UserError(
            f"no tokenizer at {printable(file)}; give a tokenizer.json, its folder, or a GGUF file"
        )
    try:
        return (
            _from_gguf(file)
            if file.suffix == ".gguf"
            else whole(Tokenizer.from_str(text_of(file, "record")))
        )
    except UserError:
        raise
    except Exception as error:  # tokenizers raises bare Exceptions on a broken file
        raise UserError(f"{printable(file)} is no readable tokenizer: {printable(error)}") from None


def whole(loaded: Any) -> Any:
    """Set a tokenizer neither to cut texts off nor to pad them, and return it.

    `loaded` is a `tokenizers.Tokenizer`.
    """
    loaded.no_truncation()
    loaded.no_padding()
    return loaded


def token_ids(loaded: Any, text: str) -> list[int]:
    """Return the token ids of a text in a chat, without special ones such as a BOS around it.

    `loaded` is a `tokenizers.Tokenizer`.
    """
    encoded: list[int] = loaded.encode(text, add_special_tokens=False).ids
    return encoded


def _from_gguf(file: Path) -> Any:
    """Build the tokenizer of a GGUF file:
    a byte-level one of its vocabulary, another by transformers.
    """
    from tokenizers import AddedToken, models

    values = read_metadata(file, arrays=True)
    pre = str(values.get("tokenizer.ggml.pre"))
    if values["tokenizer.ggml.model"] != "gpt2" or pre not in _SPLITS:
        return _converted(file, values["tokenizer.ggml.model"], pre)
    vocabulary = values["tokenizer.ggml.tokens"]
    merges = []
    for pair in values["tokenizer.ggml.merges"]:
        left, right = pair.split(" ")
        merges.append((left, right))
    number_of = {text: number for number, text in enumerate(vocabulary)}
    model = models.BPE(vocab=number_of, merges=merges, ignore_merges=pre in _WHOLE_FIRST)
    built = byte_level(model, _SPLITS[pre])
    types = values["tokenizer.ggml.token_type"]
    added = []
    for text, kind in zip(vocabulary, types, strict=True):
        if kind in (_CONTROL, _USER_DEFINED):  # those are never split, such as `<think>`
            added.append(AddedToken(text, special=kind == _CONTROL, normalized=False))
    built.add_tokens(added)
    return built


def _converted(file: Path, kind: str, pre: str) -> Any:
    """Have transformers build a tokenizer.
    Where it does not know the name, it splits text as GPT-2 does.
    """
    try:
        from transformers.integrations import gguf
        from transformers.integrations.gguf.gguf_tokenizer_mapping import GGUF_PRE_TOKENIZER_SPLITS
    except ImportError:
        raise without(f"the tokenizer of {printable(file)}", *OPTIONAL["transformers"]) from None
    if kind == "gpt2" and pre not in GGUF_PRE_TOKENIZER_SPLITS:
        raise UserError(
            f"{printable(file)} has the pre-tokeniser {printable(pre)}, which is not known here; "
            "give the model's tokenizer.json, or run it on llama-cpp"
        )
    architecture, tokenizer_fields, _ = gguf.get_gguf_tokenizer(str(file))
    built, _ = gguf.convert_gguf_tokenizer(architecture, tokenizer_fields)
    return built


def byte_level(model: Any, splits: Sequence[str] = (QWEN2_SPLIT,)) -> Any:
    """Return a `tokenizers.Tokenizer` of a byte-level BPE model.

    `model` is a `tokenizers.models.BPE`. The tokenizer splits text by the patterns `splits`, one
    after another, by default as Qwen2 does.
    """
    from tokenizers import Regex, Tokenizer, decoders, pre_tokenizers

    built = Tokenizer(model)
    built.pre_tokenizer = pre_tokenizers.Sequence(
        [
            *(pre_tokenizers.Split(Regex(split), "isolated") for split in splits),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    built.decoder = decoders.ByteLevel()
    return built


def counter(
    source: Path | None, card: Card | None = None
) -> Callable[[Iterable[Mapping[str, str]]], int] | None:
    """Return a function that counts the tokens of chat messages, without those of the template.

    The function takes the messages, dicts with the text at `content`, and returns their number. It
    uses the tokenizer at `source` (a GGUF file, a tokenizer.json or a folder with one), or else the
    one with the weights that the model card `card` names; None if there is neither. Raises
    UserError if there is no tokenizer at `source`.
    """
    if source is None and card and card.weights:
        source = _of_weights(card)
    if source is None:
        return None
    loaded = tokenizer(source)
    return lambda messages: sum(len(token_ids(loaded, m["content"])) for m in messages)


def _of_weights(card: Card) -> Path | None:
    """Return the tokenizer with a card's weights: that of a checkpoint, or its GGUF file."""
    beside = find("models", card.weights or "")
    if (beside / "tokenizer.json").is_file():
        return beside
    with suppress(UserError):  # it is not here
        return find_gguf(card) if is_gguf(card) else None
    return None


def summarize_counts(counts: Sequence[int]) -> dict[str, float]:
    """Return a dict of one or more token counts: their number `n`, `least`, `mean` and `most`."""
    mean = round(sum(counts) / len(counts), 1)
    return {"n": len(counts), "least": min(counts), "mean": mean, "most": max(counts)}
