"""Load a GGUF file with llama.cpp, in a child process since llama.cpp may abort its process."""

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import llama_cpp as c
import numpy as np

from harness.backends.adapters import foreign
from harness.core.errors import UserError, printable

_ERROR = 4  # ggml's log level of errors
_errors: list[str] = []


@c.llama_log_callback  # type: ignore[untyped-decorator]
def keep_errors(level: int, text: bytes, _: Any) -> None:
    """Keep llama.cpp's error messages for `last_error`, and drop its other log messages.

    It is the library's log callback: `level` is llama.cpp's log level, and `text` the message.
    """
    if level == _ERROR:
        _errors.append(text.decode(errors="replace").strip())


def last_error() -> str:
    """Return llama.cpp's first error message since the last call, as one line.

    Later ones are dropped, since the first names the cause.
    """
    reason = (
        printable(_errors[0].partition("\n")[0], 200) if _errors else "llama.cpp does not say why"
    )
    _errors.clear()
    return reason


class LlamaModel:
    """Hold a GGUF file loaded by llama.cpp, perhaps with a LoRA adapter.

    It is also the model's `Tokenizer`.
    """

    def __init__(
        self, name: str, file: Path, device: str | None, adapter: Path | None = None
    ) -> None:
        c.llama_log_set(keep_errors, ctypes.c_void_p(0))
        subject = f"model {name!r} in {printable(file)}"
        if device not in (None, "cpu") and not (device == "gpu" and c.llama_supports_gpu_offload()):
            devices = "cpu, gpu" if c.llama_supports_gpu_offload() else "cpu"
            raise UserError(
                f"device {printable(device)!r}; llama.cpp as it is built here has: {devices}"
            )
        params = c.llama_model_default_params()
        # ggml-org/llama.cpp#20824: repacked quantised weights crash on CPUs with AMX.
        params.use_extra_bufts = False
        if device == "cpu":
            params.n_gpu_layers = 0
        last_error()
        self.pointer = c.llama_model_load_from_file(bytes(file), params)
        if not self.pointer:
            raise UserError(
                f"{subject} does not load: {last_error()}; copy or download the file again"
            )
        self.adapter_file = adapter
        self._adapter = adapter and c.llama_adapter_lora_init(self.pointer, bytes(adapter))
        if adapter and not self._adapter:
            raise foreign(subject, adapter, last_error())
        self._vocab = c.llama_model_get_vocab(self.pointer)
        self.vocabulary: int = c.llama_vocab_n_tokens(self._vocab)
        if not self.vocabulary or c.llama_vocab_type(self._vocab) == c.LLAMA_VOCAB_TYPE_NONE:
            raise UserError(f"{subject} has no tokenizer; give a GGUF file of a chat model")
        template = c.llama_model_chat_template(self.pointer, None)
        if not template:
            raise UserError(
                f"{subject} has no chat template; give the GGUF file of its instruct version"
            )
        self.template: str = template.decode(errors="replace")
        self.trained_tokens: int = c.llama_model_n_ctx_train(self.pointer)  # length of its context
        # Number format of the weights, as llama.cpp names it.
        self.dtype = self._described().split(" ", 2)[-1].removeprefix("all ")
        self.stops = [t for t in range(self.vocabulary) if c.llama_vocab_is_eog(self._vocab, t)]
        bos, eos = c.llama_vocab_bos(self._vocab), c.llama_vocab_eos(self._vocab)
        named = {"bos_token": bos, "eos_token": eos, "pad_token": c.llama_vocab_pad(self._vocab)}
        self.specials: Mapping[str, str] = {
            key: c.llama_vocab_get_text(self._vocab, token).decode(errors="replace")
            for key, token in named.items()
            if token >= 0
        }
        self.bos: int | None = bos if bos >= 0 else None
        # Whether a sequence's state cannot be cut (recurrent layers), so that no beginning is
        # shared.
        self.whole_state: bool = c.llama_model_is_recurrent(
            self.pointer
        ) or c.llama_model_is_hybrid(self.pointer)
        self.device = "gpu" if c.llama_supports_gpu_offload() and device != "cpu" else "cpu"

    def adapt(self, context: int) -> None:
        """Apply the LoRA adapter, if there is one, to a new llama.cpp context of this model.

        `context` is the address of the context, a `llama_context` of the C library.
        """
        if self._adapter:
            adapters = (c.llama_adapter_lora_p_ctypes * 1)(self._adapter)
            if c.llama_set_adapters_lora(context, adapters, 1, (ctypes.c_float * 1)(1.0)):
                raise RuntimeError(f"llama.cpp takes no adapter here: {last_error()}")

    def encode(self, text: str) -> list[int]:
        data = text.encode(errors="replace")
        ids = np.empty(len(data) + 1, dtype=np.int32)  # a token has at least one byte
        pointer = ids.ctypes.data_as(ctypes.POINTER(c.llama_token))
        count = c.llama_tokenize(self._vocab, data, len(data), pointer, len(ids), False, True)
        if count < 0:
            raise ValueError(f"llama.cpp cannot tokenise {len(data)} bytes ({count})")
        tokens: list[int] = ids[:count].tolist()
        return tokens

    def decode(self, ids: Sequence[int]) -> str:
        return b"".join(self._piece(token) for token in ids).decode(errors="replace")

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return [self._piece(token, control=True).decode(errors="replace") for token in ids]

    def candidates(self, letters: str) -> Sequence[int]:
        return range(self.vocabulary)

    def _piece(self, token: int, control: bool = False) -> bytes:
        size = 64
        while True:
            buffer = ctypes.create_string_buffer(size)
            length: int = c.llama_token_to_piece(self._vocab, token, buffer, size, 0, control)
            if length >= 0:
                return buffer.raw[:length]
            size = -length

    def _described(self) -> str:
        """Return llama.cpp's description, such as `qwen3 4B Q4_K - Medium`."""
        buffer = ctypes.create_string_buffer(128)
        c.llama_model_desc(self.pointer, buffer, len(buffer))
        return buffer.value.decode(errors="replace")
