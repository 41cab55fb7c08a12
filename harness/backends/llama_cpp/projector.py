"""The projector of a model with vision:
a second GGUF file, with which llama.cpp's mtmd encodes pictures.
"""

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import llama_cpp as c
import numpy as np
from numpy.typing import NDArray

from harness.backends.llama_cpp.model import LlamaModel, keep_errors, last_error
from harness.backends.pictures import Pictures, locate_picture
from harness.backends.vision import Vision
from harness.core.cores import threads
from harness.core.errors import UserError, printable
from harness.core.image import Image

MOST_TOKENS = 1 << 16  # most tokens of a picture whose processor has no limit


class Run(NamedTuple):
    """Hold consecutive tokens of one text or picture, which llama.cpp reads in one call.

    `inputs` are n token ids, (n,) int32, or embeddings, (n, width) float32. `places`, (1, n), or
    (4, n) for a picture with M-RoPE (positions by time, height and width), are their positions in
    the prompt counted from that of the first, and `span` is how many positions they take.
    """

    inputs: NDArray[Any]  # token ids, (n,) int32, or embeddings, (n, width) float32
    places: NDArray[np.int32]  # relative to the first, (1, n); with M-RoPE a picture's are (4, n)
    span: int  # number of positions that they take; a picture may take fewer than it has tokens

    def at(self, start: int) -> NDArray[np.int32]:
        """Return the positions of the tokens in the prompt if the first is at position `start`.

        The shape is that of `places`. The fourth row, with M-RoPE, is no position and stays 0.
        """
        shifted = self.places + np.int32(start)
        shifted[3:] = 0
        return shifted

    def ends(self, start: int) -> Sequence[int]:
        """Return, for each token, how many positions of the prompt are taken after it.

        `start` is the position of the first; for each token of a picture it is that after the whole
        picture.
        """
        n = len(self.inputs)
        return range(start + 1, start + n + 1) if self.inputs.ndim == 1 else [start + self.span] * n


def text_run(ids: Sequence[int]) -> Run:
    """Return a text's token ids as a `Run`, which llama.cpp reads in one call.

    Each token takes one position.
    """
    return Run(np.array(ids, dtype=np.int32), np.arange(len(ids), dtype=np.int32)[None], len(ids))


class Projector:
    """Encode pictures by the loaded GGUF file of a vision encoder, to embeddings for the model.

    A picture is encoded when its tokens are first read, in an answer's time.
    """

    def __init__(self, name: str, file: Path, model: LlamaModel, vision: Vision) -> None:
        """Load a vision encoder's file for a model.

        Raises UserError if it is none, not of this model, or makes another number of tokens than
        the card says.
        """
        subject = f"model {name!r} with projector {printable(file)}"
        try:
            m = import_module("llama_cpp.mtmd_cpp")
        except (ImportError, OSError):  # OSError: its library is missing
            raise UserError(
                f"model {name!r}: llama-cpp-python was built here without what reads pictures; run "
                "`pip install --force-reinstall --no-cache-dir --no-deps llama-cpp-python`"
            ) from None
        self._m: Any = m
        self._model = model
        m.mtmd_log_set(keep_errors, ctypes.c_void_p(0))
        params = m.mtmd_context_params_default()
        params.use_gpu = model.device == "gpu"
        params.n_threads = threads()
        params.flash_attn_type = c.LLAMA_FLASH_ATTN_TYPE_DISABLED  # it rounds to F16
        params.print_timings = params.warmup = False
        if vision.scaled_to_px is None:
            square = (vision.patch_px * vision.merge) ** 2
            params.image_min_tokens = max(1, -(-(vision.least_px or 1) // square))
            params.image_max_tokens = (vision.most_px or square * MOST_TOKENS) // square
        last_error()
        self._context = m.mtmd_init_from_file(bytes(file), model.pointer, params)
        if not self._context:
            raise UserError(
                f"{subject} does not load: {last_error()}; give the mmproj file of this very model"
            )
        if not m.mtmd_support_vision(self._context):
            raise UserError(
                f"{subject} takes no pictures; give an mmproj file of a model that does"
            )
        if m.mtmd_decode_use_non_causal(self._context, None):
            raise UserError(
                f"{subject}: its pictures' tokens see those behind them, which is not done here"
            )
        self._mrope: bool = m.mtmd_decode_use_mrope(self._context)
        self._pictures = Pictures(lambda images: [self._encode(image) for image in images])
        self.forget = self._pictures.forget
        self._layouts: dict[tuple[int, ...], list[Sequence[int] | int]] = {}
        count = sum(
            n for n in self._layout((vision.height_px, vision.width_px)) if isinstance(n, int)
        )
        if count != vision.tokens:
            raise UserError(
                f"{subject} makes {count} tokens of {vision.width_px} x {vision.height_px} pixels, "
                f"and its card's [vision] {vision.tokens}; fix the card, or give the model's own "
                "projector"
            )

    def tokens(self, image: Image) -> list[int]:
        """Return the token ids that stand for a picture in a prompt.

        Ids of the picture itself are negative. The `Image` must stay alive until they are read.
        """
        layout = self._layout(image.pixels.shape[:2])
        count = sum(part for part in layout if isinstance(part, int))
        of_picture = iter(self._pictures.add(image, count))
        tokens: list[int] = []
        for part in layout:
            tokens += islice(of_picture, part) if isinstance(part, int) else part
        return tokens

    def run(self, token: int) -> Run:
        """Return the part of an encoded picture that begins with a negative token id.

        Raises LookupError if the picture is no longer alive.
        """
        number, place = locate_picture(token)
        [runs] = self._pictures.encodings([number])
        return runs[place]

    def _layout(self, shape: tuple[int, ...]) -> list[Sequence[int] | int]:
        """Return each marker's token ids, but for the template's own,
        and each picture part's token count.
        """
        if shape not in self._layouts:
            layout: list[Sequence[int] | int] = []
            with self._chunks(shape, None) as chunks:
                for chunk in chunks:
                    marker = self._marker(chunk)
                    if not marker:
                        layout.append(self._m.mtmd_input_chunk_get_n_tokens(chunk))
                    elif "".join(self._model.pieces(marker)) not in self._model.template:
                        layout.append(marker)
            self._layouts[shape] = layout
        return self._layouts[shape]

    def _marker(self, chunk: int) -> list[int]:
        """Return the token ids of a text chunk; empty for a picture's."""
        if self._m.mtmd_input_chunk_get_type(chunk) != self._m.MTMD_INPUT_CHUNK_TYPE_TEXT:
            return []
        count = ctypes.c_size_t()
        ids = self._m.mtmd_input_chunk_get_tokens_text(chunk, ctypes.byref(count))
        return [int(ids[i]) for i in range(count.value)]

    def _encode(self, image: Image) -> dict[int, Run]:
        """Encode a picture; return its parts by the place of their first token."""
        pixels = np.ascontiguousarray(image.pixels)
        runs: dict[int, Run] = {}
        place = 0
        with self._chunks(
            pixels.shape[:2], pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
        ) as chunks:
            for chunk in chunks:
                if not self._marker(chunk):
                    runs[place] = self._encoded_run(chunk)
                    place += len(runs[place].inputs)
        return runs

    def _encoded_run(self, chunk: int) -> Run:
        if self._m.mtmd_encode_chunk(self._context, chunk):
            raise RuntimeError(f"llama.cpp cannot encode the picture: {last_error()}")
        n = self._m.mtmd_input_chunk_get_n_tokens(chunk)
        width = c.llama_model_n_embd_inp(self._model.pointer)
        embeddings = np.ctypeslib.as_array(
            self._m.mtmd_get_output_embd(self._context), (n, width)
        ).copy()
        places = np.arange(n, dtype=np.int32)[None]
        if self._mrope:
            tokens = self._m.mtmd_input_chunk_get_tokens_image(chunk)
            at = [self._m.mtmd_image_tokens_get_decoder_pos(tokens, 0, i) for i in range(n)]
            places = np.array([[p.t, p.y, p.x, p.z] for p in at], dtype=np.int32).T
        return Run(embeddings, places, self._m.mtmd_input_chunk_get_n_pos(chunk))

    @contextmanager
    def _chunks(self, shape: tuple[int, ...], pixels: Any) -> Iterator[list[int]]:
        """Split a picture of (height, width) pixels with mtmd;
        without pixels, chunks have sizes only.
        """
        marker = self._m.mtmd_default_marker()
        text = self._m.mtmd_input_text(marker, len(marker), False, True)
        bitmap = ctypes.c_void_p(self._m.mtmd_bitmap_init(shape[1], shape[0], pixels))
        chunks = self._m.mtmd_input_chunks_init()
        try:
            last_error()
            if self._m.mtmd_tokenize(
                self._context, chunks, ctypes.byref(text), ctypes.byref(bitmap), 1
            ):
                raise RuntimeError(f"llama.cpp cannot take the picture: {last_error()}")
            count = self._m.mtmd_input_chunks_size(chunks)
            yield [self._m.mtmd_input_chunks_get(chunks, i) for i in range(count)]
        finally:
            self._m.mtmd_input_chunks_free(chunks)
            self._m.mtmd_bitmap_free(bitmap)
