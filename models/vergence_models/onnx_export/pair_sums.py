"""Int8 weights whose products with bytes may be added in pairs in 16 bits.

An x86 CPU without VNNI has no dot product of bytes. There onnxruntime adds two products of an
unsigned byte and an int8 weight in 16 bits, and a sum beyond 32,767 saturates. The order in which
a kernel packs the weights decides which two meet. So the rule holds for any two weights of an
output channel: two above zero sum to at most 128, two below zero to at least -128. Then no pair
exceeds 255 * 128 = 32,640, whatever the bytes are, and the sums are exact on every CPU.

Two uint8 operands are safe as they are: their kernels widen both to 16 bits and add in 32.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, numpy_helper

Array = NDArray[np.generic]

MOST = 128
# Below 128, so that two weights that are both rounded up cannot sum to 129.
_MOST_BEFORE_ROUNDING = 127.99
_REAL_PRODUCTS = frozenset({"Conv", "Gemm", "MatMul"})  # of bytes if both operands were bytes
_INTEGER_PRODUCTS = frozenset({"ConvInteger", "MatMulInteger", "QLinearConv", "QLinearMatMul"})


def largest_pair(weight: Array) -> NDArray[np.float64]:
    """The largest sum of two weights of one sign, for each output channel: [O, ...] to [O]."""
    flat = weight.reshape(len(weight), -1).astype(np.float64)
    flat = np.pad(flat, ((0, 0), (0, 2)))  # a channel may have a single weight
    of_one_sign = (np.maximum(sign * flat, 0) for sign in (1, -1))
    above, below = (np.partition(each, -2, axis=1)[:, -2:].sum(axis=1) for each in of_one_sign)
    return np.asarray(np.maximum(above, below))


def finest_steps(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """The finest step of each output channel at which the rounded weights obey the rule."""
    largest = np.abs(weight).reshape(len(weight), -1).max(axis=1)
    return np.asarray(np.maximum(largest_pair(weight) / _MOST_BEFORE_ROUNDING, largest / 127))


def range_of_rounding(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The lowest and highest that each of ``values`` [O, K], which obey the rule, may become.

    Any choice within obeys it too: at most half of the sum for all, or one alone keeps more.
    """

    def highest(values: NDArray[np.float64]) -> NDArray[np.float64]:
        row, largest = np.arange(len(values)), values.argmax(axis=1)
        alone = np.maximum(values[row, largest], MOST // 2)
        high = np.repeat(MOST - alone[:, None], values.shape[1], axis=1)
        high[row, largest] = alone
        return high

    return -highest(-values), highest(values)


def in_safe_parts(weight: NDArray[np.int8]) -> list[NDArray[np.int8]]:
    """Matrices [K, N] that obey the rule and sum to ``weight``: itself, or two halves."""
    if (largest_pair(weight.T) <= MOST).all():
        return [weight]
    half = weight // 2
    return [half, weight - half]


def overflowing(model: ModelProto) -> list[str]:
    """The results of convolutions and products whose pair sums may exceed 16 bits."""
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    made_by = {name: node for node in model.graph.node for name in node.output}
    return [node.output[0] for node in model.graph.node if not _is_safe(node, constants, made_by)]


def _is_safe(
    node: NodeProto, constants: Mapping[str, TensorProto], made_by: Mapping[str, NodeProto]
) -> bool:
    known_type: int | None = None
    if node.op_type in _INTEGER_PRODUCTS:
        # Operands of a QLinear product each have a scale and a zero point behind them.
        second = node.input[3] if node.op_type.startswith("QLinear") else node.input[1]
    elif node.op_type in _REAL_PRODUCTS:
        sources = [made_by[name] for name in node.input[:2] if name in made_by]
        if [each.op_type for each in sources] != ["DequantizeLinear"] * 2:
            return True  # a sum of reals
        second, _, *zero = sources[1].input
        known_type = next((constants[name].data_type for name in zero if name in constants), None)
    else:
        return True
    if second not in constants:
        return known_type == TensorProto.UINT8  # its values are not known before the graph runs
    if constants[second].data_type == TensorProto.UINT8:
        return True
    weight = numpy_helper.to_array(constants[second])
    turned = any(each.name == "transB" and each.i for each in node.attribute)
    channels_first = "Conv" in node.op_type or turned
    channels = weight if channels_first else np.moveaxis(weight, -1, 0)
    return bool((largest_pair(channels) <= MOST).all())
