"""Answers of a GGUF file through llama.cpp, in a process of its own."""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from harness.backends.cards import Card
from harness.backends.chat import Chat
from harness.backends.llama_cpp.child import Child
from harness.backends.transformers.checkpoint import held_to_digest
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.resources import find as beside


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "LlamaBackend":
    """Find and load a card's weights.

    Raises:
        UserError: the package or the file is missing, an option cannot be, or llama.cpp refuses the file.
    """
    if package := missing_package():
        raise UserError(
            f"model {printable(card.name)!r} needs {package}, which is not installed; "
            "run `pip install 'swarmdrive-harness[llama-cpp]'`"
        )
    if dtype not in (None, "auto"):
        raise UserError(f"dtype {printable(dtype)!r}; a GGUF file has its own: leave it out, or give auto")
    if batch_size < 1:
        raise UserError(f"batch size {batch_size}; allowed: 1 or more")
    return LlamaBackend(card, held_to_digest(card, find(card)), device, batch_size)


def missing_package() -> str | None:
    """Name of the package that is not installed; None if it is there."""
    return None if find_spec("llama_cpp") else "llama-cpp-python"


def find(card: Card) -> Path:
    """The GGUF file of a card: as given, beside the cards, or in the hub's cache.

    Raises:
        UserError: it is nowhere.
    """
    weights = card.weights or ""
    local = beside("models", weights)
    where = local / card.file if card.file else local
    if where.is_file():
        return where
    if card.file and not local.is_dir():
        from huggingface_hub import hf_hub_download

        try:
            return Path(hf_hub_download(weights, card.file, revision=card.revision, local_files_only=True))
        except (OSError, ValueError):  # not there; no hub id
            hint = f"run `harness model pull {printable(card.name)}`, or point --model at a .gguf file"
    else:
        hint = "give the path of a .gguf file"
    raise UserError(f"model {printable(card.name)!r}: no file {printable(where)}; {hint}")


class LlamaBackend(Child):
    """A GGUF file loaded in a child process.

    Attributes:
        chat: its tokenizer and chat template.
    """

    def __init__(self, card: Card, file: Path, device: str | None, batch_size: int) -> None:
        super().__init__(
            card.name, "harness.backends.llama_cpp.engine:open_here", card, file, device, batch_size
        )
        self.chat = _RemoteChat(card.name, self)

    def next_log_probs(self, prompts: Sequence[Sequence[int]], vocabulary: int) -> Floats:
        """Natural log-probabilities of the first `vocabulary` tokens after each prompt, (n, vocabulary)."""
        found: Floats = self.call("next_log_probs", prompts, vocabulary)
        return found


class _RemoteChat(Chat):
    """A chat template and tokenizer in a child."""

    def __init__(self, name: str, child: Child) -> None:
        self.name = name
        self.template = child.call("chat.template")
        self._child = child

    @property
    def bos(self) -> int | None:
        """Id of the token that begins a sequence; None if there is none."""
        token: int | None = self._child.call("chat.bos")
        return token

    def render(self, messages: Sequence[Mapping[str, str]], *, thinking: bool) -> str:
        """The prompt as the model reads it. Raises UserError where the template refuses the messages."""
        text: str = self._child.call("chat.render", messages, thinking=thinking)
        return text

    def encode(self, prompt: str) -> list[int]:
        """Token ids of a rendered prompt."""
        ids: list[int] = self._child.call("chat.encode", prompt)
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        """Text of an answer without its control tokens."""
        text: str = self._child.call("chat.decode", ids)
        return text

    def pieces(self, ids: Sequence[int]) -> list[str]:
        """The text of each token on its own, control tokens as they are written."""
        texts: list[str] = self._child.call("chat.pieces", ids)
        return texts
