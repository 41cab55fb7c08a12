"""A graph of OpenVINO as it is run here: with logits of the columns that are asked for alone.

Importing this imports openvino.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset13 as op
from openvino._offline_transformations import paged_attention_transformation

from harness.core.cores import threads
from harness.core.errors import UserError, one_line

Logits = NDArray[np.float32]

# What OpenVINO computes with, by a card's `dtype`: numbers, and keys and values. Without int8
# activations a row of a product is as exact as its numbers; `auto` leaves all to OpenVINO, which
# takes the fastest that the CPU has: int8 activations, and keys and values in 8 bits.
FORMATS: Mapping[str, Mapping[str, str]] = {
    "float32": {
        "INFERENCE_PRECISION_HINT": "f32",
        "KV_CACHE_PRECISION": "f32",
        "DYNAMIC_QUANTIZATION_GROUP_SIZE": "0",
    },
    "bfloat16": {
        "INFERENCE_PRECISION_HINT": "bf16",
        "KV_CACHE_PRECISION": "bf16",
        "DYNAMIC_QUANTIZATION_GROUP_SIZE": "0",
    },
    "auto": {},
}
FLOAT32 = {"dtype": "f32", "kv_cache": "f32", "int8_activations": "0"}  # as OpenVINO states it
_STATED = {
    "dtype": "INFERENCE_PRECISION_HINT",
    "kv_cache": "KV_CACHE_PRECISION",
    "int8_activations": "DYNAMIC_QUANTIZATION_GROUP_SIZE",
}


BLOCK = 32  # tokens of a block of keys and values, as OpenVINO has them on a CPU


class Part(NamedTuple):
    """Hold what is read of one sequence: new token ids, and where its keys and values are.

    `blocks` has room for the new tokens behind the `length` earlier ones.
    """

    ids: list[int]  # new token ids
    length: int  # number of earlier tokens
    blocks: Sequence[int]  # numbers of the blocks that have its keys and values


class OpenVinoModel:
    """Run the graph of a language model; `formats` are the numbers that it computes with."""

    def __init__(self, graph: Path, dtype: str, subject: str) -> None:
        """Load a graph. Raises UserError if it does not load."""
        self._core = ov.Core()
        try:
            model = self._core.read_model(graph)
            paged_attention_transformation(model)
            self._head = model.output("logits").get_node().input_value(0).get_node()
            _choose_columns(model, self._head)
            options = {**FORMATS[dtype], "INFERENCE_NUM_THREADS": threads()}
            self._compiled = self._core.compile_model(model, "CPU", options)
        except RuntimeError as error:
            raise UserError(
                f"{subject} does not load with OpenVINO: {one_line(error)}; run it on llama-cpp"
            ) from None
        self.vocabulary = int(model.output("logits").get_partial_shape()[2].get_length())
        self._exact_head: Any = None
        self._request = self._compiled.create_infer_request()
        self._caches: dict[str, Any] = {}  # keys and values of all blocks, by the input's name
        self._room = 0  # number of blocks that the caches have

    @cached_property
    def formats(self) -> dict[str, str]:
        """Return the number formats that OpenVINO says it computes with, by their name here."""
        formats = {}
        for name, key in _STATED.items():
            value = self._compiled.get_property(key)
            formats[name] = value.to_string() if isinstance(value, ov.Type) else str(value)
        return formats

    @property
    def features(self) -> str:
        """Return what OpenVINO says that this CPU computes fast."""
        return " ".join(sorted(self._core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")))

    def run(self, parts: Sequence[Part], columns: NDArray[Any], blocks: int, exact: bool) -> Logits:
        """Append tokens to sequences; return the logits of K of them: `(K, vocabulary)`.

        `columns`, (K,), has their places among all new tokens, and `blocks` is the number of blocks
        that there must be. `exact` wants logits computed in float32.
        """
        self._reserve(blocks)
        news = np.array([len(part.ids) for part in parts])
        lengths = np.array([part.length for part in parts])
        counts = np.array([len(part.blocks) for part in parts])
        places = [np.arange(part.length, part.length + len(part.ids)) for part in parts]
        inputs = {
            "input_ids": np.concatenate([part.ids for part in parts]).astype(np.int64),
            "position_ids": np.concatenate(places).astype(np.int64),
            "past_lens": lengths.astype(np.int32),
            "subsequence_begins": np.cumsum([0, *news], dtype=np.int32),
            "block_indices": np.concatenate([part.blocks for part in parts]).astype(np.int32),
            "block_indices_begins": np.cumsum([0, *counts], dtype=np.int32),
            "max_context_len": np.array((lengths + news).max(), dtype=np.int32),
            "columns": columns.astype(np.int64),
        }
        done = self._request.infer(inputs)
        if exact and self.formats != FLOAT32:
            return self._exact(done["hidden"][:, 0])
        logits: Logits = done["logits"][:, 0].copy()
        return logits

    def _reserve(self, blocks: int) -> None:
        """Make room for at least some blocks; what the earlier ones hold stays."""
        if blocks <= self._room:
            return
        self._room = 2 * blocks
        for port in self._compiled.inputs:
            name = port.get_any_name()
            if not name.startswith(("key_cache.", "value_cache.")):
                continue
            shape = [self._room, *(int(side.get_length()) for side in port.get_partial_shape()[1:])]
            cache = ov.Tensor(port.get_element_type(), ov.Shape(shape))
            cache.data[:] = 0
            if name in self._caches:
                earlier = self._caches[name].data
                cache.data[: len(earlier)] = earlier
            self._caches[name] = cache
            self._request.set_tensor(name, cache)

    def _exact(self, hidden: Logits) -> Logits:
        """Return the logits of hidden states (n, width), computed in float32: `(n, vocabulary)`."""
        if self._exact_head is None:
            width = op.parameter([-1, hidden.shape[-1]], np.float32)
            weights = self._head.input_value(1)
            product = op.matmul(width, weights, False, self._head.get_attributes()["transpose_b"])
            model = ov.Model([product], [width], "head")
            options = {**FORMATS["float32"], "INFERENCE_NUM_THREADS": threads()}
            self._exact_head = self._core.compile_model(model, "CPU", options)
        logits: Logits = self._exact_head(np.ascontiguousarray(hidden))[0].copy()
        return logits


def _choose_columns(model: Any, head: Any) -> None:
    """Give a graph an input `columns`, of which alone it computes logits, and an output `hidden`.

    `head` is the product that makes the logits of all columns.
    """
    columns = op.parameter([-1], np.int64, name="columns")
    columns.output(0).get_tensor().set_names({"columns"})
    chosen = op.gather(head.input_value(0), columns, op.constant(np.int64(0)))
    chosen.output(0).get_tensor().set_names({"hidden"})
    head.input(0).replace_source_output(chosen.output(0))
    model.add_parameters([columns])
    model.add_outputs([chosen.output(0)])
    model.validate_nodes_and_infer_types()
