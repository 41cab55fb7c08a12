"""Hugging Face transformers as an engine: any causal language model, on CPU or CUDA."""

from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from harness.backends.cards import Card, Dtype
from harness.backends.chat import Chat
from harness.backends.engine import Session
from harness.backends.language_model import LanguageModel
from harness.backends.transformers import checkpoint
from harness.backends.weights import find_checkpoint
from harness.core.errors import UserError, printable
from harness.core.files import sha256_bytes


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> LanguageModel:
    """Find and load a card's weights.

    Raises:
        UserError: the device, the weights or the chat template is missing, or files do not load.
    """
    dtype = dtype or card.dtype
    if dtype not in get_args(Dtype):
        raise UserError(f"dtype {printable(dtype)!r}; allowed: {', '.join(get_args(Dtype))}")
    where = find_checkpoint(card)
    loaded = checkpoint.load(card, where, dtype=dtype, device=device_of(device))
    return LanguageModel(TransformersEngine(card, where, loaded), batch_size)


def device_of(asked: str | None) -> str:
    """The device that a user means: CUDA where there is any, for None. Raises UserError for one not there."""
    import torch

    if asked is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    known = ["cpu"]
    if torch.cuda.is_available():
        known += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if asked not in known:
        raise UserError(f"device {printable(asked)!r}; this machine has: {', '.join(known)}")
    return asked


def gpus() -> list[str]:
    """Names of the GPUs that torch sees; none where it is not installed."""
    try:
        import torch
    except ImportError:
        return []

    return [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]


class TransformersEngine:
    """A loaded model with its tokenizer.

    Attributes:
        chat: its tokenizer and chat template.
        context_tokens: the card's bound, else the checkpoint's own.
        stops: token ids that end an answer, sorted.
        model: the transformers model.
    """

    def __init__(self, card: Card, where: Path, loaded: checkpoint.Loaded) -> None:
        from harness.backends.transformers.session import Reader

        self.card = card
        self.where = where
        self.chat = Chat(card.name, loaded.tokenizer)
        self.model = loaded.model
        self.context_tokens: int = (
            card.context_tokens or self.model.config.get_text_config().max_position_embeddings
        )
        listed = self.model.generation_config.eos_token_id or []
        # A chat model's turn may end with a token that its generation config does not list.
        ends = {*(listed if isinstance(listed, list) else [listed]), loaded.tokenizer.eos_token_id}
        self.stops: Sequence[int] = sorted(ends - {None})
        self._reader = Reader(self.model)

    def begin(self, prompts: Sequence[Sequence[int]]) -> Session:
        """Read some prompts. What they begin with in common, or earlier prompts did, is computed once."""
        return self._reader.begin(prompts)

    def identity(self) -> dict[str, Any]:
        """What decides the answers: a hub checkpoint is named by its commit, any other by its files."""
        cached = self.where.parent.name == "snapshots"
        return {
            "engine": "transformers",
            "transformers": version("transformers"),
            "torch": version("torch"),
            "weights": self.card.weights,
            "revision": self.where.name if cached else None,
            "files_sha256": None if cached else self._files_sha256,
            "dtype": str(self.model.dtype).removeprefix("torch."),
            "device": str(self.model.device),
            "chat_template_sha256": sha256_bytes(self.chat.template.encode()),
        }

    @cached_property
    def _files_sha256(self) -> str:
        return checkpoint.files_sha256(self.where)
