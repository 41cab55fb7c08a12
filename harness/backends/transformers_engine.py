"""Hugging Face transformers as an engine: any causal language model, on CPU or CUDA."""

from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from harness.backends import checkpoint
from harness.backends.chat import Chat
from harness.cards import Card, Dtype
from harness.errors import UserError, printable
from harness.files import sha256_bytes

if TYPE_CHECKING:
    from harness.backends.language_model import LanguageModel


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "LanguageModel":
    """Find and load a card's weights.

    Raises:
        UserError: a package, the device, the weights or the chat template is missing, or files do not load.
    """
    from harness.backends.language_model import LanguageModel

    if package := checkpoint.missing_package():
        raise UserError(
            f"model {card.name!r} needs {package}, which is not installed; "
            "run `pip install 'swarmdrive-harness[transformers]'`"
        )
    dtype = dtype or card.dtype
    if dtype not in get_args(Dtype):
        raise UserError(f"dtype {printable(dtype)!r}; allowed: {', '.join(get_args(Dtype))}")
    if batch_size < 1:
        raise UserError(f"batch size {batch_size}; allowed: 1 or more")
    where = checkpoint.find(card)
    loaded = checkpoint.load(card, where, dtype=dtype, device=_device(device))
    return LanguageModel(TransformersEngine(card, where, loaded), batch_size)


def _device(asked: str | None) -> str:
    import torch

    if asked is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    known = ["cpu"]
    if torch.cuda.is_available():
        known += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if asked not in known:
        raise UserError(f"device {printable(asked)!r}; this machine has: {', '.join(known)}")
    return asked


class TransformersEngine:
    """A loaded model with its tokenizer."""

    def __init__(self, card: Card, where: Path, loaded: checkpoint.Loaded) -> None:
        from transformers import GenerationConfig

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
        self.stops = sorted(ends - {None})
        self._pad = loaded.tokenizer.pad_token_id or 0  # masked, so any token does
        # In place of the checkpoint's own, whose sampling defaults would be merged in.
        self.model.generation_config = GenerationConfig(
            do_sample=False, eos_token_id=self.stops or None, pad_token_id=self._pad
        )

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

    def generate(self, prompts: list[list[int]], max_new_tokens: int) -> list[list[int]]:
        """What follows each prompt, decoded greedily together."""
        import torch

        width = max(map(len, prompts))
        ids = torch.full((len(prompts), width), self._pad)
        mask = torch.zeros_like(ids)
        for row, prompt in enumerate(prompts):
            ids[row, width - len(prompt) :] = torch.tensor(prompt)
            mask[row, width - len(prompt) :] = 1
        device = self.model.device
        out = self.model.generate(
            input_ids=ids.to(device), attention_mask=mask.to(device), max_new_tokens=max_new_tokens
        )
        tokens: list[list[int]] = out[:, width:].tolist()
        return tokens

    def free(self) -> None:
        """Give memory back after a failure."""
        import torch

        if self.model.device.type == "cuda":
            torch.cuda.empty_cache()
