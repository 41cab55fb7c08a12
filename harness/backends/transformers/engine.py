"""The Hugging Face transformers engine: any causal language model, on CPU or CUDA."""

import json
from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args
from warnings import catch_warnings, simplefilter

from harness.backends.adapters import CONFIG, TENSORS, find_adapter, merge
from harness.backends.card import Card, Dtype
from harness.backends.chat import Chat, HubTokenizer
from harness.backends.engine import Session
from harness.backends.language_model import LanguageModel
from harness.backends.registry import BUILT_IN
from harness.backends.weights import (
    check_digest,
    fetching,
    find_checkpoint,
    find_gguf,
    hub_commit,
    is_gguf,
    sha256_weights,
    shards,
)
from harness.core.cores import bfloat16_products, threads
from harness.core.errors import UserError, one_line, printable
from harness.core.files import digest, sha256_bytes, sha256_file, text_of
from harness.core.image import Image
from harness.core.plugins import say_once

# Suffixes of the files that decide an answer; a README or a licence does not.
_HASHED = {".bin", ".jinja", ".json", ".model", ".safetensors", ".txt"}
MOST_LAYERS = 10_000  # or experts; the largest models have some hundred


def open(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> LanguageModel:
    """Return the backend of a model card's checkpoint, loaded by the package transformers.

    `card` is the model card, the TOML file that describes a model. `device` is `cpu`, `cuda` or
    `cuda:N`, None for CUDA if there is any; `dtype` a number format instead of the card's, where
    `auto` is that of the checkpoint on CUDA, and on a CPU what `format_of_cpu` says, which is then
    said once; `batch_size` the most requests computed together. Raises UserError if the weights are
    not found, do not load, or an option is not allowed.
    """
    dtype = dtype or card.dtype
    if dtype not in get_args(Dtype):
        raise UserError(f"dtype {printable(dtype)!r}; allowed: {', '.join(get_args(Dtype))}")
    import torch

    where, device = checkpoint(card), choose_device(device)
    chosen, why = format_of_cpu() if dtype == "auto" and device == "cpu" else (dtype, "")
    torch.set_num_threads(min(threads(), torch.get_num_threads()))  # fewer may have been asked for
    tokenizer, model = load(card, where, dtype=chosen, device=device)
    if why:
        say_once(f"{card.shown}: dtype auto is {chosen} here: {why}; --dtype names another")
    return LanguageModel(TransformersEngine(card, where, tokenizer, model), batch_size)


def format_of_cpu() -> tuple[Dtype, str]:
    """Return the number format in which this processor computes fastest, and why."""
    if products := bfloat16_products():
        return "bfloat16", f"this processor multiplies in it ({products})"
    return "float32", "this processor does not multiply in bfloat16"


def checkpoint(card: Card) -> Path:
    """Return the directory of the checkpoint that a model card names, a model's TOML file.

    A GGUF file that it names is first unpacked into one. Raises UserError if it is not found, not
    complete, or not of the card's digest.
    """
    if not is_gguf(card):
        where = find_checkpoint(card)
        check_digest(card, where / "model.safetensors")
        return where
    from harness.backends.transformers.unpack import unpack_checkpoint

    if card.vision:
        raise UserError(
            f"{card.shown}: a GGUF file takes no pictures on transformers; use llama-cpp"
        )
    return unpack_checkpoint(card, check_digest(card, find_gguf(card)))


def load(card: Card, where: Path, *, dtype: str, device: str) -> tuple[Any, Any]:
    """Return the tokenizer and the model that the package transformers loads from a checkpoint.

    `where` is the checkpoint's folder, `dtype` and `device` the number format and the torch device
    of the model. Raises UserError if it does not load, lacks weights, or the two do not go
    together.
    """
    import transformers

    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    _check_config(card, where)
    subject = f"{card.shown} in {where}"
    # trust_remote_code=False: otherwise a checkpoint with its own code asks at the terminal.
    options = {"local_files_only": True, "trust_remote_code": False}
    try:
        with catch_warnings():
            simplefilter("ignore")  # what is wrong is reported below
            tokenizer = transformers.AutoTokenizer.from_pretrained(where, **options)
            kind = "AutoModelForImageTextToText" if card.vision else "AutoModelForCausalLM"
            model, report = getattr(transformers, kind).from_pretrained(
                where, dtype=dtype, output_loading_info=True, use_safetensors=True, **options
            )
    except Exception as error:  # a broken file surfaces as any of a dozen exception types
        raise UserError(f"{subject} does not load: {one_line(error)}; {fetching(card)}") from error
    try:
        model = model.to(device).eval()
    except RuntimeError as error:
        fault = f"{card.shown} does not fit on {device}: {one_line(error)}"
        raise UserError(f"{fault}; give another device or dtype") from error
    if absent := sorted(report["missing_keys"]):  # transformers fills them with random numbers
        fault = f"lacks {len(absent)} of its weights ({printable(absent[0])})"
        raise UserError(f"{subject} {fault}; {fetching(card)}")
    merge(card, model)
    rows = model.get_input_embeddings().num_embeddings
    if len(tokenizer) > rows:
        raise UserError(
            f"{subject}: its tokenizer has {len(tokenizer)} tokens and the model only {rows}; give "
            "both from one checkpoint"
        )
    if not tokenizer.chat_template:
        raise UserError(
            f"{subject} has no chat template; use its instruct version, or put a "
            "chat_template.jinja beside its config.json"
        )
    return tokenizer, model


def _check_config(card: Card, where: Path) -> None:
    """Raise UserError if a checkpoint's config names a repository for its attention,
    or too many layers.

    Where the package `kernels` is installed, transformers fetches that repository and runs its
    code. It makes the layers before it looks at the weights.
    """
    subject = f"{card.shown} in {printable(where)}"
    try:
        rest: list[Any] = [json.loads(text_of(where / "config.json", "record"))]
    except (OSError, ValueError, RecursionError):
        return  # transformers says what is wrong
    while rest:
        value = rest.pop()
        if isinstance(value, list):
            rest += value
        elif isinstance(value, dict):
            rest += value.values()
            for key in ("attn_implementation", "_attn_implementation"):
                if "/" in str(value.get(key, "")):
                    raise UserError(
                        f"{subject}: {key} in its config.json "
                        "names code of the hub, which is never run; take it out of the file"
                    )
            for key, count in value.items():
                is_count = any(word in key for word in ("layer", "depth", "expert"))
                if is_count and isinstance(count, int) and count > MOST_LAYERS:
                    raise UserError(
                        f"{subject}: {printable(key)} in its config.json is {printable(count)}, "
                        f"and at most {MOST_LAYERS}; {fetching(card)}"
                    )


def choose_device(device: str | None) -> str:
    """Return the torch device that a user names; for None CUDA if there is any, else CPU.

    Raises UserError if this machine does not have it.
    """
    import torch

    if device is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    devices = ["cpu"]
    if torch.cuda.is_available():
        devices += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if device not in devices:
        raise UserError(f"device {printable(device)!r}; this machine has: {', '.join(devices)}")
    return device


def gpus() -> list[str]:
    """Return the names of the GPUs that torch sees; empty without torch."""
    try:
        import torch
    except ImportError:
        return []
    return [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]


class TransformersEngine:
    """Read tokens and give distributions of next ones by a model of the package transformers.

    It has the loaded model, its tokenizer and perhaps its image processor.
    """

    def __init__(self, card: Card, where: Path, tokenizer: Any, model: Any) -> None:
        from harness.backends.transformers.eyes import Eyes
        from harness.backends.transformers.session import Reader

        self.card, self.where, self.model = card, where, model
        self.adapter = find_adapter(card)
        self.eyes = Eyes(card.name, where, card.vision, tokenizer, model) if card.vision else None
        image_token = self.eyes.image_token if self.eyes else None
        self.chat = Chat(card.name, HubTokenizer(tokenizer), image_token, card.system)
        self.context_tokens: int = (
            card.context_tokens or model.config.get_text_config().max_position_embeddings
        )
        listed = model.generation_config.eos_token_id or []
        # A chat model's turn may end with a token that its generation config does not list: the
        # template's.
        ends = {
            *(listed if isinstance(listed, list) else [listed]),
            tokenizer.eos_token_id,
            *self.chat.ends,
        }
        self.stops: Sequence[int] = sorted(ends - {None})
        self._reader = Reader(model, self.eyes)

    def look(self, image: Image) -> list[int]:
        if self.eyes is None:
            raise ValueError(f"{self.card.name} takes no pictures")
        return self.eyes.look(image)

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Session:
        return self._reader.begin(prompts, exact)

    def forget(self) -> None:
        self._reader.forget()

    def identity(self) -> dict[str, Any]:
        """Return what decides the answers, by name: versions, weights, number format and device.

        A hub checkpoint is named by its commit, others by a digest of their files.
        """
        commit = hub_commit(self.where)
        identity: dict[str, Any] = {
            "engine": "transformers",
            "answers": BUILT_IN["transformers"].answers,
            "transformers": version("transformers"),
            "torch": version("torch"),
            "weights": self.card.weights,
            "revision": commit,
            "files_sha256": None if commit else self._files_sha256,
            "dtype": str(self.model.dtype).removeprefix("torch."),
            "device": str(self.model.device),
            "chat_template_sha256": sha256_bytes(self.chat.template.encode()),
        }
        if is_gguf(self.card):
            identity["gguf_sha256"] = self._gguf_sha256
        if self.adapter:
            identity["adapter_sha256"] = sha256_file(self.adapter / TENSORS)
            identity["adapter_config_sha256"] = sha256_file(self.adapter / CONFIG)
        if self.chat.system:
            identity["system"] = self.chat.system
        return identity

    @cached_property
    def _files_sha256(self) -> str:
        files = [p.name for p in self.where.iterdir() if p.is_file() and p.suffix in _HASHED]
        names = {*files, *shards(self.where)}
        return digest({name: sha256_file(self.where / name) for name in names})

    @cached_property
    def _gguf_sha256(self) -> str:
        return sha256_weights(find_gguf(self.card))
