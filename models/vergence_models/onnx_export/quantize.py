"""Int8 convolutions for an exported graph (QDQ), where its plan chooses bytes.

Activations are uint8; weights are int8, symmetric, with a scale per output channel. For this pair
onnxruntime has its fastest kernels, three to four times as fast as float32. Images are bytes from
the start. All sums are exact on every CPU (:mod:`vergence_models.onnx_export.pair_sums`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from vergence_models.onnx_export.pair_sums import finest_steps, in_safe_parts
from vergence_models.onnx_export.quantization_plan import COPYING_OPS, QuantizationPlan
from vergence_models.onnx_export.rounding import PatchStatistics, rounded

Array = NDArray[np.generic]

# The fast kernel computes at least so many outputs; those not needed are cut off.
KERNEL_OUTPUTS = 16
BYTES = ".bytes"  # suffix of a tensor's name: the same tensor as bytes


@dataclass(frozen=True, slots=True)
class ByteScale:
    """A real number is ``step * (byte - zero)``."""

    step: np.float32
    zero: np.uint8

    @classmethod
    def of_range(cls, low: float, high: float) -> ByteScale:
        """The finest that reaches from ``low`` to ``high`` and has an exact 0."""
        low, high = min(low, 0.0), max(high, 1e-6)
        step = (high - low) / 255
        return cls(np.float32(step), np.uint8(round(-low / step)))


def with_weights_apart(model: ModelProto) -> ModelProto:
    """The same graph, where weights that it would split at run time are separate constants."""
    model = copy_of(model)
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    for node in [node for node in model.graph.node if node.op_type == "Split"]:
        if len(node.input) < 2 or any(name not in constants for name in node.input):
            continue
        whole, sizes = (constants[name] for name in node.input)
        axis = next((entry.i for entry in node.attribute if entry.name == "axis"), 0)
        parts = np.split(whole, np.cumsum(sizes)[:-1], axis=axis)
        model.graph.initializer.extend(
            numpy_helper.from_array(np.ascontiguousarray(part), name)
            for part, name in zip(parts, node.output, strict=True)
        )
        model.graph.node.remove(node)
    read = {name for node in model.graph.node for name in node.input}
    for tensor in [tensor for tensor in model.graph.initializer if tensor.name not in read]:
        model.graph.initializer.remove(tensor)
    return model


def quantized(
    model: ModelProto,
    what: QuantizationPlan,
    scales: dict[str, ByteScale],
    inputs: Mapping[str, PatchStatistics] | None = None,
) -> ModelProto:
    """The same graph with Quantize and Dequantize nodes where the plan wants bytes.

    ``inputs`` are statistics of the convolutions' inputs, by output tensor. The weights of other
    convolutions become the nearest whole numbers.
    """
    writer = _Writer(model, what, scales, inputs or {})
    for entry in model.graph.input:
        writer.send_as_bytes(entry.name)
    for node in model.graph.node:
        if node.output[0] not in what.absorbed:
            writer.copy(node)
        for name in node.output:
            writer.send_as_bytes(name)
    return writer.finished()


class _Writer:
    """The nodes of the new graph in their order, and its constants."""

    def __init__(
        self,
        model: ModelProto,
        what: QuantizationPlan,
        scales: dict[str, ByteScale],
        inputs: Mapping[str, PatchStatistics],
    ) -> None:
        self._model = model
        self._plan = what
        self._inputs = inputs
        scales = {**scales, **dict.fromkeys(what.images, ByteScale(np.float32(1), np.uint8(0)))}
        self._scales = {name: scales[source] for name, source in what.source.items()}
        self._old = {tensor.name: tensor for tensor in model.graph.initializer}
        self._outputs = {output.name for output in model.graph.output}
        self._new: dict[str, TensorProto] = {}
        self._nodes: list[NodeProto] = []
        self._reading: dict[str, str] = {}  # tensor -> what its readers read instead
        self._as_bytes: set[str] = set()  # tensors all of which there is as NAME.bytes
        self._asked: dict[str, int] = {}  # result of a widened convolution -> channels asked for

    def send_as_bytes(self, name: str) -> None:
        """Let the readers of a tensor read bytes, if the plan says so and they do not yet."""
        if name not in self._scales or name in self._reading:
            return
        real = self._plan.absorbed.get(name, name)
        # The contract's outputs keep their name, and what they were before the bytes.
        reading = self._through_bytes(real, name, name)
        if real not in self._asked:
            self._as_bytes.add(name)
        else:
            ends = {"start": [0], "end": [self._asked[real]], "axis": [1]}
            cut = [self._constant(f"{name}.{end}", np.array(ends[end], np.int64)) for end in ends]
            reading = self._add("Slice", [reading, *cut], f"{name}.asked")
        self._reading[name] = reading

    def copy(self, node: NodeProto) -> None:
        copied = NodeProto.FromString(node.SerializeToString())
        inputs = [self._reading.get(name, name) for name in node.input]
        result = node.output[0]
        if result in self._plan.convolutions:
            inputs[1:] = self._weights(node)
        elif result in self._plan.images and result in self._scales:
            self._add("Identity", inputs, result + BYTES)
            self._read_bytes(result)
            return
        elif node.op_type == "MatMul" and self._sums_bytes(node):
            self._add_integer_product(node)
            return
        elif node.op_type == "Concat" and result in self._scales:
            inputs = [
                each
                if name in self._scales
                else self._through_bytes(each, f"{result}.{at}", result)
                for at, (name, each) in enumerate(zip(node.input, inputs, strict=True))
            ]
        elif node.op_type == "Resize" and node.input[0] in self._scales and self._doubles(node):
            self._add_doubled(node.input[0], result)
            return
        elif node.op_type == "Shape" and node.input[0] in self._as_bytes:
            inputs[0] = node.input[0] + BYTES
        elif (
            node.op_type in COPYING_OPS
            and node.input[0] in self._as_bytes
            and result not in self._outputs
        ):
            copied.input[:] = [node.input[0] + BYTES, *inputs[1:]]
            copied.output[:] = [result + BYTES]
            self._nodes.append(copied)
            self._read_bytes(result)
            return
        del copied.input[:]
        copied.input.extend(inputs)
        self._nodes.append(copied)

    def finished(self) -> ModelProto:
        model = copy_of(self._model)
        read = {name for node in self._nodes for name in node.input}
        kept = [tensor for name, tensor in self._old.items() if name in read]
        del model.graph.node[:], model.graph.initializer[:]
        model.graph.node.extend(self._nodes)
        model.graph.initializer.extend([*kept, *self._new.values()])
        return model

    def _through_bytes(self, real: str, name: str, like: str) -> str:
        """Quantise ``real`` with the scale of ``like``; returns the dequantised tensor's name."""
        by = self._scale(like)
        self._add("QuantizeLinear", [real, *by], name + BYTES)
        return self._add("DequantizeLinear", [name + BYTES, *by], f"{name}.real")

    def _scale(self, name: str) -> list[str]:
        scale = self._scales[name]
        return [
            self._constant(f"{name}.step", scale.step),
            self._constant(f"{name}.zero", scale.zero),
        ]

    def _doubles(self, node: NodeProto) -> bool:
        """Return True if each cell becomes four equal ones."""
        how = {entry.name: entry.s for entry in node.attribute}
        scales = self._old.get(node.input[2]) if len(node.input) == 3 else None
        return (
            scales is not None
            and numpy_helper.to_array(scales).tolist() == [1, 1, 2, 2]
            and how.get("mode") == b"nearest"
            and how.get("nearest_mode") == b"floor"
            and how.get("coordinate_transformation_mode") == b"asymmetric"
            and node.input[0] not in self._asked
        )

    def _add_doubled(self, name: str, result: str) -> None:
        """Twice the size by copies of bytes, channels last: first of columns, then of rows."""
        twice = self._constant("twice", np.array([1, 2, 2, 1], np.int64))
        rows = self._constant("rows", np.array([0, 0, -1], np.int64))
        cells = self._add("Transpose", [name + BYTES], f"{result}.cells", perm=[0, 2, 3, 1])
        shape = self._add("Shape", [cells], f"{result}.half")
        shape = self._add("Mul", [shape, twice], f"{result}.shape")
        wide = self._add("Concat", [cells, cells], f"{result}.pairs", axis=3)
        wide = self._add("Reshape", [wide, rows], f"{result}.rows")
        high = self._add("Concat", [wide, wide], f"{result}.blocks", axis=2)
        high = self._add("Reshape", [high, shape], f"{result}.last")
        self._add("Transpose", [high], result + BYTES, perm=[0, 3, 1, 2])
        self._read_bytes(result)

    def _read_bytes(self, result: str) -> None:
        """Let the readers of ``result`` read its dequantised bytes, which exist already."""
        inputs = [result + BYTES, *self._scale(result)]
        self._reading[result] = self._add("DequantizeLinear", inputs, f"{result}.real")
        self._as_bytes.add(result)

    def _sums_bytes(self, node: NodeProto) -> bool:
        """Return True if it multiplies an image with whole numbers that fit into bytes."""
        image, weight = node.input
        if image not in self._plan.images or weight not in self._old:
            return False
        values = numpy_helper.to_array(self._old[weight])
        return bool((values == np.rint(values)).all() and np.abs(values).max() <= 127)

    def _add_integer_product(self, node: NodeProto) -> None:
        image, weight = node.input
        values = numpy_helper.to_array(self._old[weight]).astype(np.int8)
        sums = []
        for at, part in enumerate(in_safe_parts(values)):
            end = f".{at}" if at else ""
            inputs = [self._plan.images[image], self._constant(weight + BYTES + end, part)]
            sums.append(self._add("MatMulInteger", inputs, f"{node.output[0]}.whole{end}"))
        whole = self._add("Add", sums, f"{node.output[0]}.sum") if len(sums) > 1 else sums[0]
        self._add("Cast", [whole], node.output[0], to=TensorProto.FLOAT)

    def _weights(self, node: NodeProto) -> list[str]:
        """Weight and bias of a convolution as int8 and int32."""
        result, into = node.output[0], float(self._scales[node.input[0]].step)
        weight = numpy_helper.to_array(self._old[node.input[1]]).astype(np.float64)
        bias = np.zeros(len(weight))
        if len(node.input) > 2:
            bias += numpy_helper.to_array(self._old[node.input[2]])
        spare = KERNEL_OUTPUTS - len(weight)
        if spare > 0 and weight.shape[2] > 1 and result not in self._outputs:
            self._asked[result] = len(weight)
            weight = np.pad(weight, ((0, spare), (0, 0), (0, 0), (0, 0)))
            bias = np.pad(bias, (0, spare))
        # Fine enough for the weights, and coarse enough for the bias, in 32 bits.
        step = np.maximum(finest_steps(weight), np.abs(bias) / into / 2**30)
        step = np.maximum(step, 1e-12).astype(np.float32)
        seen = self._inputs.get(result)
        flat, wide = weight.reshape(len(weight), -1), step.astype(np.float64)
        whole = rounded(flat, wide, None if seen is None else seen.covariance)
        if seen is not None:
            bias += (flat - whole * wide[:, None]) @ seen.mean
        whole = whole.reshape(weight.shape)
        bias = np.rint(bias / (step * into))
        return [
            self._dequantized(f"{result}.weight", whole.astype(np.int8), step),
            self._dequantized(f"{result}.bias", bias.astype(np.int32), step * into),
        ]

    def _dequantized(self, name: str, values: Array, step: Array) -> str:
        zero = np.zeros(step.shape, values.dtype)
        parts = {"bytes": values, "step": step.astype(np.float32), "zero": zero}
        inputs = [self._constant(f"{name}.{part}", array) for part, array in parts.items()]
        return self._add("DequantizeLinear", inputs, f"{name}.real", axis=0)

    def _constant(self, name: str, value: Array | np.generic) -> str:
        self._new[name] = numpy_helper.from_array(np.asarray(value), name)
        return name

    def _add(
        self, operator: str, inputs: list[str], output: str, **attributes: int | list[int]
    ) -> str:
        node = helper.make_node(operator, inputs, [output])
        node.attribute.extend(helper.make_attribute(*each) for each in attributes.items())
        self._nodes.append(node)
        return output


def copy_of(model: ModelProto) -> ModelProto:
    return ModelProto.FromString(model.SerializeToString())
