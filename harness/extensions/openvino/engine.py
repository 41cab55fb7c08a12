"""The OpenVINO engine: GGUF files on a CPU.

It has the interface of `harness.backends.engine`, so the answer modes are those of every engine.
Importing this imports openvino.
"""

from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from harness.backends.card import Card, Dtype
from harness.backends.chat import Chat
from harness.backends.engine import Session
from harness.backends.language_model import LanguageModel
from harness.backends.weights import find_gguf, hub_commit, sha256_weights
from harness.core.errors import UserError, printable
from harness.core.files import sha256_bytes
from harness.core.image import Image
from harness.extensions.openvino.graph import graph_of_card
from harness.extensions.openvino.model import OpenVinoModel
from harness.extensions.openvino.registered import REGISTRATION
from harness.extensions.openvino.session import Reader
from harness.extensions.openvino.tokenizer import GgufTokenizer


def open_model(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> LanguageModel:
    """Return the backend of a model card's GGUF file, run by OpenVINO on the CPU.

    `card` is the model card, the TOML file that describes a model. `dtype` says what OpenVINO
    computes with, instead of the card's: `auto` is its own choice, the fastest, with int8
    activations; `float32` and `bfloat16` have none. `batch_size` is the most requests computed
    together. Raises UserError if the file is not found, does not load, or an option is not allowed.
    """
    if device not in (None, "cpu"):
        raise UserError(f"device {printable(device)!r}; the engine openvino has: cpu")
    dtype = dtype or card.dtype
    if dtype not in get_args(Dtype):
        raise UserError(f"dtype {printable(dtype)!r}; allowed: {', '.join(get_args(Dtype))}")
    graph, file = graph_of_card(card), find_gguf(card)
    subject = f"{card.shown} in {printable(file)}"
    tokenizer = GgufTokenizer(file, subject)
    model = OpenVinoModel(graph, dtype, subject)
    if tokenizer.vocabulary > model.vocabulary:
        raise UserError(
            f"{subject}: its tokenizer has {tokenizer.vocabulary} tokens and the model only "
            f"{model.vocabulary}; download the file again"
        )
    return LanguageModel(OpenVinoEngine(card, file, tokenizer, model), batch_size)


class OpenVinoEngine:
    """Read tokens and give distributions of next ones by a graph that OpenVINO runs."""

    def __init__(
        self, card: Card, file: Path, tokenizer: GgufTokenizer, model: OpenVinoModel
    ) -> None:
        self.chat = Chat(card.name, tokenizer, system=card.system)
        self.context_tokens = card.context_tokens or tokenizer.context_tokens
        self.stops: Sequence[int] = sorted({*tokenizer.ends, *self.chat.ends})
        self._card, self._file, self._model = card, file, model
        self._reader = Reader(model)

    def look(self, image: Image) -> list[int]:
        raise ValueError(f"{self._card.shown} takes no pictures on openvino")

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Session:
        return self._reader.begin([list(prompt) for prompt in prompts], bool(exact))

    def forget(self) -> None:
        self._reader.forget()

    def identity(self) -> dict[str, Any]:
        """Return what decides the answers, by name: versions, the file, and number formats.

        The number formats and the features of the CPU are those that OpenVINO states.
        """
        commit = hub_commit(self._file.parent)
        identity: dict[str, Any] = {
            "engine": "openvino",
            "answers": REGISTRATION.answers,
            "openvino": version("openvino"),
            "openvino_genai": version("openvino-genai"),
            "system": self._model.features,
            "weights": self._card.weights,
            "file": self._card.file,
            "revision": commit,
            "file_sha256": None if commit else self._sha256,
            **self._model.formats,
            "device": "cpu",
            "chat_template_sha256": sha256_bytes(self.chat.template.encode()),
        }
        if self.chat.system:
            identity["system_text"] = self.chat.system
        return identity

    @cached_property
    def _sha256(self) -> str:
        return sha256_weights(self._file)
