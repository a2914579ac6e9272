"""The choice of tensors of an exported graph that become bytes.

These are convolutions of features with their inputs and outputs, sums of such outputs, and products
of features that are only looked up in: of their millions of scores few are ever read. Images are
bytes from the start. Everything else stays float32, so positions and disparities lose nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from onnx import ModelProto, NodeProto, TensorProto

from vergence_models.onnx_export.stitch import SIGMA_PART

# Operators that pass on their values, and so their scale, unchanged.
COPYING_OPS = frozenset(
    {"Gather", "GatherElements", "Reshape", "Squeeze", "Transpose", "Unsqueeze"}
)
LAYOUT_OPS = COPYING_OPS | {"Resize"}
# Bytes that start at 0 include these operators. A clip's upper end becomes that of the range.
ACTIVATIONS = frozenset({"Relu", "Clip"})
# A convolution of a gray image would gain little: its differences are what matching starts from.
MIN_CHANNELS = 4


@dataclass(frozen=True, slots=True, eq=False)
class QuantizationPlan:
    """The convolutions of a graph that become int8, and the tensors that become bytes."""

    convolutions: frozenset[str]  # names of the convolutions' output tensors
    products: frozenset[str]  # names of the matrix products' output tensors
    images: dict[str, str]  # image as floats -> the same image as bytes
    source: dict[str, str]  # tensor -> the tensor whose scale it shares, mostly itself
    absorbed: dict[str, str]  # output of an activation -> its input

    @property
    def measured(self) -> list[str]:
        """The tensors whose ranges have to be known."""
        return sorted(set(self.source.values()) - set(self.images))


def plan_quantization(model: ModelProto) -> QuantizationPlan:
    """Choose the convolutions of features, their inputs and outputs, and sums of these."""
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    readers: dict[str, list[NodeProto]] = {}
    for node in model.graph.node:
        for name in node.input:
            readers.setdefault(name, []).append(node)
    source: dict[str, str] = {}
    absorbed: dict[str, str] = {}

    def give_bytes(result: str) -> None:
        """Make a result bytes, after its activation if that is its only reader."""
        following = readers.get(result, [])
        if len(following) == 1 and following[0].op_type in ACTIVATIONS:
            absorbed[following[0].output[0]] = result
            result = following[0].output[0]
        source.setdefault(result, result)

    def only_looked_up(name: str) -> bool:
        return all(
            reader.op_type in ("GatherElements", "Shape")
            or (reader.op_type in COPYING_OPS and only_looked_up(reader.output[0]))
            for reader in readers.get(name, [])
        )

    convolutions, products = set(), set()
    images: dict[str, str] = {}
    of_bytes = {
        entry.name
        for entry in model.graph.input
        if entry.type.tensor_type.elem_type == TensorProto.UINT8
    }
    for node in model.graph.node:  # in the order they run in
        result = node.output[0]
        if node.name.startswith(f"{SIGMA_PART}."):
            continue  # sigma spans five orders of magnitude, and the part is small
        if node.op_type == "Conv" and node.input[1] in constants:
            few = constants[node.input[1]].dims[1] < MIN_CHANNELS
            if few and node.input[0] not in images:
                continue
            convolutions.add(result)
            source.setdefault(node.input[0], node.input[0])
            give_bytes(result)
        elif node.op_type == "MatMul" and result in readers and only_looked_up(result):
            products.add(result)
            source.update((name, name) for name in (*node.input, result) if name not in source)
        elif node.op_type == "Add" and all(name in source for name in node.input):
            give_bytes(result)
        elif node.op_type in LAYOUT_OPS and node.input[0] in source:
            source[result] = source[node.input[0]]
        elif node.op_type in (*COPYING_OPS, "Slice") and node.input[0] in of_bytes:
            of_bytes.add(result)
        elif node.op_type == "Cast" and node.input[0] in of_bytes:
            images[result] = node.input[0]
        elif node.op_type == "Cast" and casts_to_bytes(node):
            of_bytes.add(result)
    # A tensor that only such an operator reads is copied or concatenated as bytes.
    made_by = {name: node for node in model.graph.node for name in node.output}
    for node in reversed(model.graph.node):
        whole, result = node.input[0] if node.input else "", node.output[0]
        if node.op_type not in LAYOUT_OPS or result not in source or len(readers[whole]) > 1:
            continue
        if node.op_type in COPYING_OPS or (whole in made_by and made_by[whole].op_type == "Concat"):
            source.setdefault(whole, source[result])
    return QuantizationPlan(frozenset(convolutions), frozenset(products), images, source, absorbed)


def casts_to_bytes(node: NodeProto) -> bool:
    return any(entry.name == "to" and entry.i == TensorProto.UINT8 for entry in node.attribute)
