"""Fetching a card's weights from its hub: once, by hand. Nothing else in the program downloads anything."""

import sys
from pathlib import Path

from harness.backends.cards import WEIGHTED, Card
from harness.backends.llama_cpp import backend as llama_backend
from harness.backends.transformers import checkpoint
from harness.core.errors import UserError, printable
from harness.core.resources import find


def pull(card: Card) -> Path:
    """Download what a card's engine needs and is not there yet, into the hub's cache.

    Returns:
        The checkpoint's directory, or the GGUF file.

    Raises:
        UserError: there is nothing to fetch, the hub is not reached or refuses, or what came is not what the
            card says.
    """
    if card.engine not in WEIGHTED:
        raise UserError(f"model {printable(card.name)!r} runs on {card.engine}: it has no weights to pull")
    here = find("models", card.weights or "")
    if here.exists():
        raise UserError(f"model {printable(card.name)!r} lies in {printable(here)}: nothing to pull")
    _download(card)
    if card.engine == "llama-cpp":
        return checkpoint.held_to_digest(card, llama_backend.find(card))
    where = checkpoint.find(card)
    checkpoint.held_to_digest(card, where / "model.safetensors")
    return where


def _download(card: Card) -> None:
    from huggingface_hub import constants, errors, snapshot_download
    from huggingface_hub.utils import disable_progress_bars, logging

    logging.set_verbosity_error()
    if not sys.stderr.isatty():
        disable_progress_bars()
    patterns = [card.file] if card.file else checkpoint.FILES
    shown, at = (
        f"model {printable(card.name)!r}",
        f"{printable(constants.ENDPOINT)}/{printable(card.weights)}",
    )
    try:
        snapshot_download(card.weights or "", revision=card.revision, allow_patterns=patterns)
    except errors.GatedRepoError:
        raise UserError(
            f"{shown}: {at} asks for its licence to be accepted; do so on that page, then `hf auth login`"
        ) from None
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError):
        revision = f" at {printable(card.revision)}" if card.revision else ""
        raise UserError(
            f"{shown}: there is no {at}{revision}, or it is private; see `hf auth login`"
        ) from None
    except Exception as error:  # the hub, the network and the disk fail in any of a dozen types
        reason = printable(" ".join(str(error).split()), 160)
        raise UserError(
            f"{shown}: cannot fetch {at}: {reason}; try again, or copy the weights here and give their path"
        ) from None
