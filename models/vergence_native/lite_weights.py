"""The weights of `lite`, taken from its exported int8 graphs.

The kernels compute one network: that of the graphs whose structure has the digests below. A graph
of another structure is refused, whatever its weights are. Retraining changes no structure.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vergence_native.onnx_graph import Array, Graph, Node, UnsupportedWeights

# Digests of the operators of each part, their attributes, connections and fixed constants.
STRUCTURE = {
    "begin_0": (
        "847aa292cdcc51eba46eba849b297dc0adf77cbf77040a478e5978e900ef6da0",
        # Images of twice the size: without the warp of the state.
        "632fb73fe0eae869135d7e04202b01a925f0ccbc2985da0bf1461b634175efe2",
    ),
    "begin_1": ("4742a137b0e9540dc07112dfe6cafee6c95b4f108672b32be4eb7b021a0cfd89",),
    "iterate": ("11c16b3006fd2be8a5394ca4fd818d4d76567d16686b5c09c8072c0b1feea55c",),
    "sigma": ("1e70ee55621e727d391628e54c6a69a9949639df5b5304316fccffac4973fa8e",),
    "end": ("10fa2b20e4a71d23638585e50aa2a50798be007eee32169b0e80cb94681aacdf",),
}
# Operators that pass on their values. How often they do depends on the graph round a part.
_VIEWS = frozenset(
    {"DequantizeLinear", "Identity", "QuantizeLinear", "Reshape", "Shape", "Squeeze", "Unsqueeze"}
)


class ByteScale(NamedTuple):
    """A real number is ``step * (byte - zero)``."""

    step: float
    zero: int


@dataclass(frozen=True, slots=True, eq=False)
class ConvWeights:
    """A convolution of bytes."""

    weights: NDArray[np.int8]  # [O, I, K, K]
    steps: NDArray[np.float32]  # [O]
    bias: NDArray[np.int32]  # [O], in units of an input step times a weight step
    stride: tuple[int, int]
    given: ByteScale
    made: ByteScale


class SumWeights(NamedTuple):
    """The sum of two tensors of bytes."""

    first: ByteScale
    second: ByteScale
    made: ByteScale


@dataclass(frozen=True, slots=True, eq=False)
class PartWeights:
    """The weights of one part of a step, in the order in which its graph has them."""

    convolutions: list[ConvWeights]
    sums: list[SumWeights]
    floats: list[NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class LiteWeights:
    """The weights of a step of so many iterations."""

    begin: PartWeights
    iterations: list[PartWeights]
    end: PartWeights


class _Part:
    """The nodes of one part of a graph, which has names of its own: PREFIX.NAME."""

    def __init__(self, graph: Graph, prefix: str, kind: str) -> None:
        # The first graphs' outputs may be made again in a later file; the first node counts.
        own = [node for node in graph.nodes if node.outputs[0].startswith(f"{prefix}.")]
        self.nodes = list({node.outputs[0]: node for node in reversed(own)}.values())[::-1]
        self.graph = graph
        self.made_by = {name: node for node in graph.nodes for name in node.outputs}
        self.read_by: dict[str, list[Node]] = {}
        for node in graph.nodes:
            for name in node.inputs:
                self.read_by.setdefault(name, []).append(node)
        self.prefix = prefix
        self.kind = kind

    def weights(self) -> PartWeights:
        digest = self.digest()
        if digest not in STRUCTURE[self.kind]:
            raise UnsupportedWeights(
                f"{self.prefix} has another structure than the native kernels compute "
                f"(digest {digest})"
            )
        convolutions = [self._conv(node) for node in self.nodes if self._is_of_bytes(node)]
        sums = [self._sum(node) for node in self.nodes if self._adds_bytes(node)]
        floats = {
            "begin_0": self._coarse_floats,
            "begin_1": self._fine_floats,
            "iterate": self._fine_sharpness,
            "end": self._sigma,
            "sigma": self._layers,
        }[self.kind]()
        return PartWeights(convolutions, sums, floats)

    def digest(self) -> str:
        learned = {id(node) for node in self._with_learned_scalars()}
        # The last iteration alone hands on its doubt.
        computing = [
            node
            for node in self.nodes
            if node.op_type not in _VIEWS and not node.outputs[0].endswith(".to_doubt")
        ]
        numbers = {node.outputs[0]: number for number, node in enumerate(computing)}
        text = hashlib.sha256()
        for node in computing:
            words = [node.op_type, str(sorted(node.attributes.items(), key=lambda item: item[0]))]
            for name in node.inputs:
                constant = self.graph.constants.get(name)
                if constant is None:
                    viewed = self._viewed(name)
                    outside = viewed.removesuffix(".real").removesuffix(".bytes")
                    outside = outside.rpartition(".")[2].removeprefix("to_")
                    words.append(str(numbers.get(viewed, outside)))
                elif id(node) in learned or constant.size > 64 or node.op_type == "Conv":
                    words.append(f"{constant.dtype.str}{constant.shape}")
                else:
                    words.append(f"{constant.dtype.str}{constant.shape}{constant.tolist()}")
            text.update((";".join(words) + "\n").encode())
        return text.hexdigest()

    def _viewed(self, name: str) -> str:
        """The tensor that ``name`` is a view of, or the same with bytes for its values."""
        while name.startswith(f"{self.prefix}."):
            node = self.made_by.get(name)
            if node is None or node.op_type not in _VIEWS:
                break
            name = node.inputs[0]
        return name

    def _with_learned_scalars(self) -> Iterator[Node]:
        if self.kind == "begin_0":
            claim = self._claim()
            yield claim
            yield from self._sharpness_of(self._scores())
        elif self.kind == "iterate":
            yield from self._fine_products()
        elif self.kind == "end":
            yield from self._sigma_chain()

    def _is_of_bytes(self, node: Node) -> bool:
        weight = self.made_by.get(node.inputs[1]) if node.op_type == "Conv" else None
        return weight is not None and weight.op_type == "DequantizeLinear"

    def _adds_bytes(self, node: Node) -> bool:
        sources = [self.made_by.get(name) for name in node.inputs]
        return (
            node.op_type == "Add"
            and all(each is not None and each.op_type == "DequantizeLinear" for each in sources)
            and any(each.op_type == "QuantizeLinear" for each in self.read_by[node.outputs[0]])
        )

    def _constant(self, name: str) -> Array:
        if name not in self.graph.constants:
            raise UnsupportedWeights(f"{name} is not a constant")
        return self.graph.constants[name]

    def _scalar(self, name: str) -> float:
        value = self._constant(name)
        if value.size != 1:
            raise UnsupportedWeights(f"{name} is not a scalar")
        return float(value.reshape(-1)[0])

    def _scale_of(self, node: Node) -> ByteScale:
        """The scale of a Quantize or a Dequantize node."""
        return ByteScale(self._scalar(node.inputs[1]), int(self._scalar(node.inputs[2])))

    def _read_as(self, name: str) -> ByteScale:
        return self._scale_of(self._source(name, "DequantizeLinear"))

    def _made_as(self, name: str) -> ByteScale:
        quantising = [node for node in self.read_by[name] if node.op_type == "QuantizeLinear"]
        if len(quantising) != 1:
            raise UnsupportedWeights(f"{name} is not quantised")
        return self._scale_of(quantising[0])

    def _source(self, name: str, op_type: str) -> Node:
        node = self.made_by.get(name)
        if node is None or node.op_type != op_type:
            raise UnsupportedWeights(f"{name} does not come from {op_type}")
        return node

    def _conv(self, node: Node) -> ConvWeights:
        weight, bias = (self._source(name, "DequantizeLinear") for name in node.inputs[1:3])
        values = self._constant(weight.inputs[0])
        biases = self._constant(bias.inputs[0])
        steps = self._constant(weight.inputs[1])
        rows, columns = values.shape[2:] if values.ndim == 4 else (0, 0)
        if (
            values.dtype != np.int8
            or biases.dtype != np.int32
            or rows != columns
            or steps.shape != biases.shape
            or steps.shape != values.shape[:1]
        ):
            raise UnsupportedWeights(f"{node.outputs[0]} has weights of another type or shape")
        stride = node.attributes["strides"]
        if not (isinstance(stride, tuple) and len(stride) == 2):
            raise UnsupportedWeights(f"{node.outputs[0]} has no strides")
        return ConvWeights(
            np.ascontiguousarray(values, np.int8),
            np.ascontiguousarray(steps, np.float32),
            np.ascontiguousarray(biases, np.int32),
            (int(stride[0]), int(stride[1])),
            self._read_as(node.inputs[0]),
            self._made_as(node.outputs[0]),
        )

    def _sum(self, node: Node) -> SumWeights:
        first, second = (self._read_as(name) for name in node.inputs)
        return SumWeights(first, second, self._made_as(node.outputs[0]))

    def _census(self) -> list[NDArray[np.float32]]:
        """The filters of the left and the right image."""
        filters = [
            self._constant(node.inputs[1])
            for node in self.nodes
            if node.op_type == "Conv" and not self._is_of_bytes(node)
        ]
        return [np.ascontiguousarray(each, np.float32).reshape(-1) for each in filters]

    def _scores(self) -> Node:
        """The node of `fixed`: scores plus a factor times the claim of another surface."""
        name = f"{self.prefix}.fixed"
        return self._source(name, "Add")

    def _claim(self) -> Node:
        return self._source(self._scores().inputs[1], "Mul")

    def _sharpness_of(self, scores: Node) -> list[Node]:
        """The products of narrow, middle and wide scores with their factors."""
        outer = self._source(scores.inputs[0], "Add")
        inner = self._source(outer.inputs[0], "Add")
        names = (*inner.inputs, outer.inputs[1])
        return [self._source(name, "Mul") for name in names]

    def _coarse_floats(self) -> list[NDArray[np.float32]]:
        factors = [self._factor(node) for node in self._sharpness_of(self._scores())]
        factors.append(self._factor(self._claim()))
        return [*self._census(), np.array(factors, np.float32)]

    def _factor(self, node: Node) -> float:
        """The constant factor of a product."""
        names = [name for name in node.inputs if name in self.graph.constants]
        if len(names) != 1:
            raise UnsupportedWeights(f"{node.outputs[0]} is no product with a constant")
        return self._scalar(names[0])

    def _fine_floats(self) -> list[NDArray[np.float32]]:
        """Filters, and the scales of the left and right descriptors and of their products."""
        products = [node for node in self.nodes if node.op_type == "MatMul"]
        if len(products) != 1:
            raise UnsupportedWeights(f"{self.prefix} has no single product of descriptors")
        right, left = (self._read_as(name) for name in products[0].inputs)
        scales = (*left, *right, *self._made_as(products[0].outputs[0]))
        return [*self._census(), np.array(scales, np.float32)]

    def _fine_products(self) -> list[Node]:
        """The products of costs, their means and the sub-pixel fit with their factors."""
        products = [
            node
            for node in self.nodes
            if node.op_type == "Mul"
            and any(
                name.rpartition(".")[2].startswith(("select_", "subpixel")) for name in node.inputs
            )
            and any(name in self.graph.constants for name in node.inputs)
        ]
        if len(products) != 3:
            raise UnsupportedWeights(f"{self.prefix} has {len(products)} learned factors, not 3")
        return products

    def _fine_sharpness(self) -> list[NDArray[np.float32]]:
        return [np.array([self._factor(node) for node in self._fine_products()], np.float32)]

    def _sigma_chain(self) -> list[Node]:
        """Doubt to sigma: a product, a clip, the exponential, and a product."""
        exps = [node for node in self.nodes if node.op_type == "Exp"]
        for exp in exps:
            clip = self.made_by.get(exp.inputs[0])
            if clip is not None and clip.op_type == "Clip":
                readers = self.read_by[exp.outputs[0]]
                return [self._source(clip.inputs[0], "Mul"), clip, exp, readers[0]]
        raise UnsupportedWeights(f"{self.prefix} has no sigma")

    def _sigma(self) -> list[NDArray[np.float32]]:
        product, clip, _, scaled = self._sigma_chain()
        values = [
            self._factor(product),
            *(self._scalar(name) for name in clip.inputs[1:]),
            self._factor(scaled),
        ]
        return [np.array(values, np.float32)]

    def _layers(self) -> list[NDArray[np.float32]]:
        """Weights and then biases of each layer, in their order."""
        layers = [node for node in self.nodes if node.op_type == "Conv"]
        if len(layers) != 2:
            raise UnsupportedWeights(f"{self.prefix} has {len(layers)} layers, not 2")
        return [
            np.concatenate(
                [self._constant(name).reshape(-1) for name in layer.inputs[1:3]], dtype=np.float32
            )
            for layer in layers
        ]


def read_weights(
    graph: Graph, *, iterations: Sequence[int], begin: str = "", end: str = "end"
) -> LiteWeights:
    """The weights of the iterations with these numbers.

    ``begin`` is a prefix of the names of the parts before them, ``end`` the name of the part after.
    Raises UnsupportedWeights.
    """
    wide = _Part(graph, f"{begin}begin_0", "begin_0").weights()
    narrow = _Part(graph, f"{begin}begin_1", "begin_1").weights()
    coarse_left, coarse_right, sharpness = wide.floats
    fine_left, fine_right, pairs = narrow.floats
    # Means of coarse and fine bits; a division by the number of channels in the network.
    means = [np.float32(1 / 48), np.float32(1 / 16)]
    floats = [
        coarse_left,
        coarse_right,
        fine_left,
        fine_right,
        sharpness,
        np.array([*pairs, *means], np.float32),
    ]
    last = _Part(graph, end, "end").weights()
    sigma = _Part(graph, "sigma", "sigma").weights()
    return LiteWeights(
        PartWeights([*wide.convolutions, *narrow.convolutions], narrow.sums, floats),
        [_Part(graph, f"iterate_{number}", "iterate").weights() for number in iterations],
        PartWeights(last.convolutions, last.sums, [*last.floats, *sigma.floats]),
    )
