"""Answers of a causal language model through Hugging Face transformers, greedily decoded."""

import time
from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, get_args

from harness.backends import checkpoint
from harness.backends.base import Completion, Request
from harness.backends.chat import Chat
from harness.cards import Card, Dtype
from harness.errors import UserError, printable
from harness.files import sha256_bytes


class _Prompt(NamedTuple):
    """One request as the engine sees it."""

    position: int
    request: Request
    ids: list[int]


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "TransformersBackend":
    """Find and load a card's weights.

    Raises:
        UserError: a package, the device, the weights or the chat template is missing, or files do not load.
    """
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
    return TransformersBackend(card, where, loaded, batch_size)


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


class TransformersBackend:
    """A loaded model with its tokenizer."""

    def __init__(self, card: Card, where: Path, loaded: checkpoint.Loaded, batch_size: int) -> None:
        from transformers import GenerationConfig

        self.card = card
        self.where = where
        self.batch_size = batch_size
        self.chat = Chat(card.name, loaded.tokenizer)
        self.model = loaded.model
        self.context_tokens: int = (
            card.context_tokens or self.model.config.get_text_config().max_position_embeddings
        )
        listed = self.model.generation_config.eos_token_id or []
        # A chat model's turn may end with a token that its generation config does not list.
        ends = {*(listed if isinstance(listed, list) else [listed]), loaded.tokenizer.eos_token_id}
        self._stops = sorted(ends - {None})
        self._pad = loaded.tokenizer.pad_token_id or 0  # masked, so any token does
        # In place of the checkpoint's own, whose sampling defaults would be merged in.
        self.model.generation_config = GenerationConfig(
            do_sample=False, eos_token_id=self._stops or None, pad_token_id=self._pad
        )

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order.

        `completion_tokens` counts what was generated, the stop token included, padding not. Requests of
        like length share a batch. A batch that fails is asked again, one request at a time.
        """
        done: dict[int, Completion] = {}
        fitting = []
        for position, request in enumerate(requests):
            ids = self.chat.encode(self.chat.render(request.messages, thinking=request.thinking))
            if len(ids) + request.max_tokens > self.context_tokens:
                done[position] = _failed(request, len(ids), self._overflow(len(ids), request.max_tokens))
            else:
                fitting.append(_Prompt(position, request, ids))
        fitting.sort(key=lambda p: (p.request.max_tokens, len(p.ids)), reverse=True)
        for start in range(0, len(fitting), self.batch_size):
            batch = fitting[start : start + self.batch_size]
            for prompt, completion in zip(batch, self._answer(batch), strict=True):
                done[prompt.position] = completion
        return [done[position] for position in range(len(requests))]

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

    def _overflow(self, prompt_tokens: int, max_tokens: int) -> str:
        return (
            f"context overflow: {prompt_tokens + max_tokens} tokens > {self.context_tokens} "
            f"({prompt_tokens} in the prompt, {max_tokens} for the answer)"
        )

    def _answer(self, batch: list[_Prompt]) -> list[Completion]:
        answered = self._try(batch)
        if isinstance(answered, list):
            return answered
        # Out here the failed batch's tensors are gone, so the retry has the whole memory.
        self._free()
        completions = []
        for prompt in batch:
            alone = self._try([prompt])
            if isinstance(alone, list):
                completions += alone
            else:
                completions.append(_failed(prompt.request, len(prompt.ids), alone))
                self._free()
        return completions

    def _try(self, batch: list[_Prompt]) -> list[Completion] | str:
        """Completions of a batch, or the engine's message."""
        try:
            start_s = time.perf_counter()
            generated = self._generate([p.ids for p in batch], max(p.request.max_tokens for p in batch))
            seconds = time.perf_counter() - start_s
        except Exception as error:  # an engine may fail in any way; what it says is data
            return f"{type(error).__name__}: {printable(' '.join(str(error).split()), 200)}"
        alone = seconds if len(batch) == 1 else None
        return [
            self._completion(p, tokens, alone, len(batch)) for p, tokens in zip(batch, generated, strict=True)
        ]

    def _generate(self, prompts: list[list[int]], max_new_tokens: int) -> list[list[int]]:
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

    def _completion(
        self, prompt: _Prompt, tokens: list[int], seconds: float | None, batch_size: int
    ) -> Completion:
        tokens = tokens[: prompt.request.max_tokens]
        end = next((i for i, token in enumerate(tokens) if token in self._stops), None)
        return Completion(
            request_id=prompt.request.id,
            text=self.chat.decode(tokens[:end]),
            prompt_tokens=len(prompt.ids),
            completion_tokens=len(tokens) if end is None else end + 1,
            finish_reason="length" if end is None else "stop",
            seconds=seconds,
            batch_size=batch_size,
        )

    def _free(self) -> None:
        import torch

        if self.model.device.type == "cuda":
            torch.cuda.empty_cache()


def _failed(request: Request, prompt_tokens: int, error: str) -> Completion:
    return Completion(request.id, "", prompt_tokens, None, "error", None, 1, error)
