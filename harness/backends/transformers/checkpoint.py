"""A checkpoint on disk: where it lies, whether it is whole, and its loading.

Nothing is ever downloaded here: a person fetches weights once (`harness.backends.pull`).
"""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from harness.backends.cards import Card
from harness.core.errors import UserError, printable
from harness.core.files import digest, sha256_file
from harness.core.resources import find as beside

# Without these AutoTokenizer builds an empty tokenizer and says nothing.
_TOKENIZERS = ("tokenizer.json", "tokenizer.model", "vocab.json")
_WEIGHTS = ("*.safetensors", "*.bin")
# What transformers loads; a repository's other formats of the same weights would come on top. Fetching and
# looking both name these: the hub's cache calls a snapshot incomplete that lacks a file nobody needs.
FILES = ["*.json", "*.jinja", "*.model", "*.safetensors", "*.txt"]
# What decides an answer; a README or a licence does not.
_HASHED = {".bin", ".jinja", ".json", ".model", ".safetensors", ".txt"}


class Loaded(NamedTuple):
    """A tokenizer and its model, in memory."""

    tokenizer: Any
    model: Any


def missing_package() -> str | None:
    """Name of the package that is not installed; None if all are there."""
    return next((name for name in ("torch", "transformers") if find_spec(name) is None), None)


def find(card: Card) -> Path:
    """Directory of a card's weights: as given, beside the cards, or in the hub's cache.

    Raises:
        UserError: it is nowhere, or its config, weights or tokenizer are not there.
    """
    weights = card.weights or ""
    local = beside("models", weights)
    where = local if local.is_dir() else _cached(card, weights)
    wanted = {"config.json": ("config.json",), "weights": _WEIGHTS, "tokenizer": _TOKENIZERS}
    for what, patterns in wanted.items():
        if not any(path.is_file() for pattern in patterns for path in where.glob(pattern)):
            raise UserError(
                f"model {card.name!r} in {where} has no {what} ({' or '.join(patterns)}); {_fetch(card)}"
            )
    return where


def load(card: Card, where: Path, *, dtype: str, device: str) -> Loaded:
    """Tokenizer and model of a checkpoint, ready to answer.

    Raises:
        UserError: files that do not load, weights that do not fill the model, no chat template.
    """
    import transformers

    held_to_digest(card, where / "model.safetensors")
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    # trust_remote_code=False: else a checkpoint with code of its own asks at the terminal.
    options = {"local_files_only": True, "trust_remote_code": False}
    try:
        tokenizer = transformers.AutoTokenizer.from_pretrained(where, **options)
        model, report = transformers.AutoModelForCausalLM.from_pretrained(
            where, dtype=dtype, output_loading_info=True, **options
        )
    except Exception as error:  # a broken file surfaces as any of a dozen exception types
        reason = printable(" ".join(str(error).split()), 200)
        raise UserError(f"model {card.name!r} in {where} does not load: {reason}; {_fetch(card)}") from error
    try:
        model = model.to(device).eval()
    except RuntimeError as error:
        reason = printable(" ".join(str(error).split()), 200)
        raise UserError(
            f"model {card.name!r} does not fit on {device}: {reason}; give another device or dtype"
        ) from error
    if report["missing_keys"]:
        # transformers fills them with random numbers.
        absent = sorted(report["missing_keys"])
        raise UserError(
            f"model {card.name!r} in {where} lacks {len(absent)} of its weights "
            f"({printable(absent[0])}); {_fetch(card)}"
        )
    rows = model.get_input_embeddings().num_embeddings
    if len(tokenizer) > rows:
        raise UserError(
            f"model {card.name!r} in {where}: its tokenizer has {len(tokenizer)} tokens and the model "
            f"only {rows}; give both from one checkpoint"
        )
    if not tokenizer.chat_template:
        raise UserError(
            f"model {card.name!r} in {where} has no chat template; use its instruct version, "
            "or put a chat_template.jinja beside its config.json"
        )
    return Loaded(tokenizer, model)


def held_to_digest(card: Card, file: Path) -> Path:
    """The file, if the card's digest is the file's, or the card has none. Raises UserError if it is not."""
    if card.sha256 and (found := sha256_file(file) if file.is_file() else "no such file") != card.sha256:
        raise UserError(
            f"model {printable(card.name)!r}: {printable(file)} is not what its card says: sha256 {found}, "
            f"and the card has {card.sha256}; fetch it again, or mend the card"
        )
    return file


def vocabulary(where: Path) -> int:
    """How many tokens the model of a checkpoint knows, padding rows included."""
    config = json.loads((where / "config.json").read_text(encoding="utf-8"))
    return int(config["vocab_size"])


def files_sha256(where: Path) -> str:
    """Digest of the files of a checkpoint that decide its answers, by name and content."""
    files = sorted(path for path in where.iterdir() if path.is_file() and path.suffix in _HASHED)
    return digest({path.name: sha256_file(path) for path in files})


def _cached(card: Card, weights: str) -> Path:
    from huggingface_hub import constants, snapshot_download

    try:
        return Path(
            snapshot_download(weights, revision=card.revision, allow_patterns=FILES, local_files_only=True)
        )
    except (OSError, ValueError):  # not there; no hub id
        at = f" at revision {card.revision!r}" if card.revision else ""
        raise UserError(
            f"model {card.name!r}: no directory {weights!r}, and none{at} in the hub cache "
            f"{constants.HF_HUB_CACHE}; {_fetch(card)}"
        ) from None


def _fetch(card: Card) -> str:
    if Path(card.weights or "").is_absolute():
        return "copy the checkpoint again, or give another directory"
    return f"run `harness model pull {printable(card.name)}`, or point --model at a local directory"
