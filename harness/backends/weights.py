"""A card's weights on disk: find them, check that they are complete, and download them on request.

Nothing else in the program downloads anything.
"""

import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from harness.backends import packages
from harness.backends.adapters import find_adapter
from harness.backends.card import Card
from harness.backends.gguf import ModelFacts, read_facts
from harness.backends.registry import (
    capabilities,
    engine_answer,
    locate,
    missing_package,
    registration,
)
from harness.core.errors import UserError, printable
from harness.core.files import opened, sha256_files, text_of
from harness.core.resources import find

# Without one of these AutoTokenizer silently builds an empty tokenizer.
_TOKENIZERS = ("tokenizer.json", "tokenizer.model", "vocab.json")
# a pickle, such as pytorch_model.bin, may hold code and is never read
_WEIGHTS = ("*.safetensors",)
_SMALL, _LARGE = {".json", ".jinja", ".model", ".txt"}, {".safetensors"}
_SHARDS = "model.safetensors.index.json"
# The files that transformers loads; a repository may hold the same weights in other formats as
# well.
_FIRST_SPLIT = re.compile(r"-00001-of-(\d{5})\.gguf$")  # llama.cpp opens the others by itself
_FETCHED = ["*.json", "*.jinja", "*.model", "*.safetensors", "*.txt"]


def find_checkpoint(card: Card) -> Path:
    """Return the directory of the checkpoint that a model card (a model's TOML file) names.

    It is looked for as the path given, beside the cards, and in the hub's cache. Raises UserError
    if there is none, or it lacks a file.
    """
    find_adapter(card)
    local = find("models", card.weights or "")
    where = local if local.is_dir() else _snapshot(card)
    if where is None:
        at = f" at revision {card.revision!r}" if card.revision else ""
        raise UserError(
            f"{card.shown}: no directory {card.weights!r}, and none{at} in the hub cache "
            f"{_hub_cache()}; {fetching(card)}"
        )
    _check_files(card, where)
    required = {"config.json": ("config.json",), "weights": _WEIGHTS, "tokenizer": _TOKENIZERS}
    for shard in shards(where):
        if not (where / shard).is_file():
            fault = f"{card.shown} in {where} has no shard {printable(shard)}"
            raise UserError(f"{fault}; {fetching(card)}")
    for what, patterns in required.items():
        if not any(path.is_file() for pattern in patterns for path in where.glob(pattern)):
            names = " or ".join(patterns)
            raise UserError(f"{card.shown} in {where} has no {what} ({names}); {fetching(card)}")
    return where


def _check_files(card: Card, checkpoint: Path) -> None:
    """Raise UserError if a file that the engine would open by itself is none,
    or is too large to be it.
    """
    in_subfolders = [checkpoint / name for name in shards(checkpoint) if "/" in name]
    for path in (*checkpoint.iterdir(), *in_subfolders):
        try:
            if path.suffix in _SMALL or path.suffix in _LARGE:
                opened(path, "record" if path.suffix in _SMALL else "weights").close()
        except OSError as error:
            fault = f"{printable(path)} cannot be read: {error.strerror}"
            raise UserError(f"{card.shown}: {fault}; {fetching(card)}") from None


def find_gguf(card: Card) -> Path:
    """Return the GGUF file that a model card (a model's TOML file) names.

    It is looked for as the path given, beside the cards, in a package, and in the hub's cache.
    Raises UserError if there is none, or its projector (the file of its vision encoder) is missing.
    """
    find_adapter(card)
    if wanted := packages.find_packaged(card):
        if not wanted.place.is_file():
            raise UserError(
                f"{wanted.subject} is not fetched yet; run `harness model pull "
                f"{printable(card.name)}`"
            )
        return wanted.place
    local = find("models", card.weights or "")
    where = local / card.file if card.file else local
    hint = "give the path of a .gguf file"
    if card.file and not local.is_dir():
        hint = f"run `harness model pull {printable(card.name)}`, or point --model at a .gguf file"
        where = (_snapshot(card) or local) / card.file
    if not where.is_file():
        raise UserError(f"{card.shown}: no file {printable(where)}; {hint}")
    if card.projector and not (beside := where.with_name(card.projector)).is_file():
        raise UserError(
            f"{card.shown}: no projector {printable(beside)}; put it beside the model's "
            f"file, or run `harness model pull {printable(card.name)}` where it is on the hub"
        )
    for part in gguf_files(where)[1:]:
        if not part.is_file():
            raise UserError(
                f"{card.shown}: no file {printable(part)}, of the model's {len(gguf_files(where))} "
                f"files; {hint}"
            )
    return where


def gguf_files(file: Path) -> list[Path]:
    """Return the files of a GGUF model, given its first: one, or all into which it was split."""
    split = _FIRST_SPLIT.search(file.name)
    if split is None:
        return [file]
    stem, count = file.name[: split.start()], split[1]
    names = [f"{stem}-{number:05}-of-{count}.gguf" for number in range(1, int(count) + 1)]
    return [file.with_name(name) for name in names]


def sha256_weights(file: Path) -> str:
    """Return the hex SHA-256 digest of a file of weights.

    Of a GGUF model in several files it is that of all, one after another, as of
    `cat NAME-*.gguf | sha256sum`; `file` is the first.
    """
    return sha256_files(gguf_files(file))


def is_gguf(card: Card) -> bool:
    """Return whether the weights that a model card names are a GGUF file, whatever the engine.

    A model card is the TOML file that describes a model.
    """
    weights = card.file or card.weights or ""
    return weights.endswith(".gguf") or weights.startswith(packages.PREFIX)


def find_weights(card: Card) -> Path:
    """Return the checkpoint's directory or the GGUF file of a model card, a model's TOML file.

    Raises UserError if there is none, or it is not complete.
    """
    return find_gguf(card) if is_gguf(card) else find_checkpoint(card)


def check_digest(card: Card, file: Path) -> Path:
    """Return `file`, after comparing its SHA-256 with that in its model card, if any.

    The digest is that of `sha256_weights`.

    A model card is the TOML file that describes a model. Raises UserError if they differ.
    """
    if (
        card.sha256
        and (digest := sha256_weights(file) if file.is_file() else "no such file") != card.sha256
    ):
        raise UserError(
            f"{card.shown}: {printable(file)} is not what its card says: sha256 {digest}, "
            f"and the card has {card.sha256}; fetch it again, or fix the card"
        )
    return file


def contradictions(card: Card) -> Iterator[str]:
    """Yield a line for each fact that a model card states otherwise than the model's own files do.

    The facts are the licence, and a context length above that of the weights. A model card is a
    TOML file that describes a model; a run uses what it states. Raises UserError if the weights are
    not found.
    """
    where = locate(card)
    facts = (
        read_facts(where) if where.is_file() else ModelFacts(context_tokens=_context_tokens(where))
    )
    if card.licence and facts.licence and card.licence.casefold() != facts.licence.casefold():
        yield (
            f"licence {printable(card.licence)} by its card, {printable(facts.licence)} by its "
            "file; correct the card, or ask who made the file"
        )
    if card.context_tokens and facts.context_tokens and card.context_tokens > facts.context_tokens:
        yield (
            f"context of {card.context_tokens} tokens by its card, {facts.context_tokens} by its "
            "weights: what is longer was never trained; lower context_tokens"
        )


def _context_tokens(checkpoint: Path) -> int | None:
    """Return the longest sequence that a checkpoint's config allows; None if it does not say."""
    try:
        config = json.loads(text_of(checkpoint / "config.json", "record"))
        longest = config.get("text_config", config).get("max_position_embeddings")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return longest if isinstance(longest, int) else None


def pull(card: Card) -> Path:
    """Download the weights that a model card names, and return the checkpoint or GGUF file.

    They go into a cache. A model card is the TOML file that describes a model. Raises UserError if
    there is nothing to fetch, the hub or the registry is not reached or refuses, or the digest is
    not the card's.
    """
    if not capabilities(card.engine).has_weights:
        raise UserError(f"{card.shown} runs on {card.engine}: it has no weights to pull")
    if wanted := packages.find_packaged(card):
        packages.fetch(wanted)
    elif (here := find("models", card.weights or "")).exists():
        raise UserError(f"{card.shown} lies in {printable(here)}: nothing to pull")
    else:
        _download(card)
    engine, where = registration(card.engine), locate(card)
    check_digest(card, where if where.is_file() else where / "model.safetensors")
    if engine.prepares and missing_package(card.engine) is None:
        engine_answer(card, engine.prepares)
    return where


def _download(card: Card) -> None:
    from huggingface_hub import constants, errors, snapshot_download
    from huggingface_hub.utils import disable_progress_bars, logging

    logging.set_verbosity_error()
    if not sys.stderr.isatty():
        disable_progress_bars()
    named = [name for name in (card.file, card.projector) if name]
    patterns = [_FIRST_SPLIT.sub(r"-*-of-\1.gguf", name) for name in named] or _FETCHED
    at = f"{printable(constants.ENDPOINT)}/{printable(card.weights)}"
    try:
        snapshot_download(card.weights or "", revision=card.revision, allow_patterns=patterns)
    except errors.GatedRepoError:
        raise UserError(
            f"{card.shown}: {at} asks for its licence to be accepted; do so on that page, then `hf "
            "auth login`"
        ) from None
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError):
        revision = f" at {printable(card.revision)}" if card.revision else ""
        raise UserError(
            f"{card.shown}: there is no {at}{revision}, or it is private; see `hf auth login`"
        ) from None
    except Exception as error:  # the hub, the network and the disk fail in any of a dozen types
        # Its first sentence, as long as it may be: those after it give advice of the library's own.
        reason = printable(" ".join(str(error).split()).partition(". ")[0].rstrip("."), 400)
        raise UserError(
            f"{card.shown}: cannot fetch {at}: {reason}; try again, or copy the weights here and "
            "give their path"
        ) from None


def hub_commit(folder: Path) -> str | None:
    """Return the commit that a folder of the hub's cache holds; None for any other folder.

    The hub is the server of public models from which weights are downloaded. A folder of another
    place that is called so has its files' digests in the identity instead.
    """
    is_commit = re.fullmatch(r"[0-9a-f]{40}", folder.name) is not None
    in_cache = folder.resolve().is_relative_to(_hub_cache().resolve())
    return folder.name if is_commit and in_cache and folder.parent.name == "snapshots" else None


def fetching(card: Card) -> str:
    """Return the advice, for an error message, on how to get a checkpoint that is not complete.

    `card` is the model card that names it, the TOML file that describes a model.
    """
    if Path(card.weights or "").is_absolute():
        return "copy the checkpoint again, or give another directory"
    return f"run `harness model pull {printable(card.name)}`, or point --model at a local directory"


def _hub_cache() -> Path:
    """Return the cache folder of the hub's package, without importing it,
    which would slow down listings.
    """
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("HF_HOME") or f"{home}/huggingface"
    cache = (
        os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE") or f"{home}/hub"
    )
    return Path(os.path.expandvars(os.path.expanduser(cache)))


def _snapshot(card: Card) -> Path | None:
    """Return the folder of a card's repository at its revision in the hub's cache;
    None if there is none.
    """
    repository = _hub_cache() / f"models--{(card.weights or '').replace('/', '--')}"
    revision = card.revision or "main"
    reference = repository / "refs" / revision
    commit = text_of(reference).strip() if reference.is_file() else revision
    snapshot = repository / "snapshots" / commit
    return snapshot if snapshot.is_dir() else None


def shards(checkpoint: Path) -> list[str]:
    """Return the files that a checkpoint's weights are split into, by their paths within it.

    They may lie in folders of it, and an interrupted download lacks some.
    """
    try:
        index = json.loads(text_of(checkpoint / _SHARDS, "record"))
        return sorted(map(str, set(index["weight_map"].values())))
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return []
