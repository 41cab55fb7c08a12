"""A checkpoint on disk: loading it, and what is in it."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from harness.backends.cards import Card
from harness.backends.weights import fetching, held_to_digest
from harness.core.errors import UserError, printable
from harness.core.files import digest, sha256_file

# What decides an answer; a README or a licence does not.
_HASHED = {".bin", ".jinja", ".json", ".model", ".safetensors", ".txt"}


class Loaded(NamedTuple):
    """A tokenizer and its model, in memory."""

    tokenizer: Any
    model: Any


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
        raise UserError(
            f"model {card.name!r} in {where} does not load: {reason}; {fetching(card)}"
        ) from error
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
            f"({printable(absent[0])}); {fetching(card)}"
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


def vocabulary(where: Path) -> int:
    """How many tokens the model of a checkpoint knows, padding rows included."""
    config = json.loads((where / "config.json").read_text(encoding="utf-8"))
    return int(config["vocab_size"])


def files_sha256(where: Path) -> str:
    """Digest of the files of a checkpoint that decide its answers, by name and content."""
    files = sorted(path for path in where.iterdir() if path.is_file() and path.suffix in _HASHED)
    return digest({path.name: sha256_file(path) for path in files})
