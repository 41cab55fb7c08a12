"""The weights of a graph that openvino-genai made, as exact as the GGUF file has them.

A block of the format Q4_1 is 32 numbers `scale * q + low`. openvino-genai rounds `low / scale` to
an integer: SmolLM2-135M then has weights that are 8 % off, and seven of ten next tokens are others.
Here each row is found again in the file by its scales, and gets the numbers that stand there.

Importing this imports gguf and openvino.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gguf import GGUFReader
from numpy.typing import NDArray
from openvino import opset13 as op

READ_EXACTLY = ("F16", "Q8_0")  # by openvino-genai itself
REPAIRED = "Q4_1"
_BLOCK_BYTES = 20  # of Q4_1: its scale and its lowest number in float16, and 32 numbers of 4 bits


def check_kinds(file: Path) -> None:
    """Raise ValueError if a GGUF file has weights in a number format that is not read exactly."""
    matrices = [tensor for tensor in GGUFReader(file).tensors if len(tensor.shape) > 1]
    kinds = {tensor.tensor_type.name for tensor in matrices}
    allowed = (*READ_EXACTLY, REPAIRED)
    if other := sorted(kinds.difference(allowed)):
        formats = ", ".join(allowed)
        raise ValueError(f"its weights are in {', '.join(other)}; read exactly are {formats}")


def repair(model: Any, file: Path) -> None:
    """Give the weights of a graph, an `ov.Model`, the numbers that its GGUF file has in Q4_1.

    Raises ValueError if a row of the graph is not in the file, or the file does not say which.
    """
    lows = _lows(file)
    for product in model.get_ordered_ops():
        weight = _four_bits(product)
        if weight is None:
            continue
        numbers, scales, end = weight
        if any(row.tobytes() not in lows for row in scales[:, :, 0]):
            raise ValueError("it makes weights of 4 bits that the file does not have")
        low = np.stack([lows[row.tobytes()] for row in scales[:, :, 0]])[:, :, None]
        scale = scales.astype(np.float32)
        zero = np.divide(-low, scale, out=np.zeros_like(scale), where=scale != 0)
        differences = op.subtract(op.convert(numbers, np.float32), op.constant(zero))
        weights = op.multiply(differences, op.constant(scale))
        shaped = op.reshape(weights, op.constant(np.array(end.shape, dtype=np.int64)), False)
        for user in list(end.output(0).get_target_inputs()):
            user.replace_source_output(shaped.output(0))
    model.validate_nodes_and_infer_types()


def _lows(file: Path) -> Mapping[bytes, NDArray[np.float32]]:
    """Return the lowest numbers of a row's blocks, by the bytes of the row's scales."""
    lows: dict[bytes, NDArray[np.float32]] = {}
    for tensor in GGUFReader(file).tensors:
        if tensor.tensor_type.name != REPAIRED:
            continue
        data = np.array(tensor.data)
        blocks = data.reshape(data.shape[0], -1, _BLOCK_BYTES)
        heads = np.ascontiguousarray(blocks[:, :, :4]).view(np.float16)
        for scale, low in zip(heads[:, :, 0], heads[:, :, 1], strict=True):
            if not (scale.all() or (low[scale == 0] == 0).all()):
                raise ValueError("a block of its weights has no scale and is not 0")
            key, row = scale.tobytes(), low.astype(np.float32)
            if not np.array_equal(lows.setdefault(key, row), row):
                raise ValueError("two rows of its weights have the same scales")
    return lows


def _four_bits(product: Any) -> tuple[Any, NDArray[np.float16], Any] | None:
    """Return the 4-bit constant, the scales and the last node of a weight that a product makes."""
    if product.get_type_name() != "Multiply":
        return None
    differences, scales = (product.input_value(n).get_node() for n in (0, 1))
    if differences.get_type_name() != "Subtract" or scales.get_type_name() != "Constant":
        return None
    converted = differences.input_value(0).get_node()
    numbers = converted.input_value(0).get_node() if converted.get_input_size() else converted
    if numbers.get_element_type().to_string() != "u4":
        return None
    end = product
    for name in ("Reshape", "Convert"):
        [user] = end.output(0).get_target_inputs()
        end = user.get_node()
        if end.get_type_name() != name:
            raise ValueError(f"a weight is followed by {end.get_type_name()} and no {name}")
    return numbers, scales.get_data(), end
