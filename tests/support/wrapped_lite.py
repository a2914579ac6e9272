"""The graphs of `lite` as one graph with the face of a foreign network."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from tests.support.foreign_graphs import Affine
from vergence_models.foreign.guess import Given
from vergence_proto.model_io import DISPARITY, LEFT, RIGHT, UVD_CURR_FROM_PREV, ModelCard

Shape = list[str | int]


@dataclass(frozen=True, slots=True)
class Face:
    """How a foreign network takes images and returns disparity."""

    inputs: dict[str, Shape]
    views: Callable[["Wrapped"], tuple[str, str]]  # float [1, 3, H, W], bytes again
    affine: Affine
    output: str
    factor: float
    given: Given
    channels_last: bool = False


class Wrapped:
    """The graphs of `lite` for a fixed size [H, W], as one graph with another face.

    ``flow`` is the input of an initial flow to the left, in cells of 1/4 of the image: the
    disparity that a step of `lite` starts from. What else it remembers is left out.
    """

    def __init__(
        self, card: ModelCard, size: tuple[int, int], *, iterations: int = 1, flow: str = ""
    ) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self.opsets: dict[str, int] = {}
        self._card = card
        self._size = size
        self._iterations = iterations
        self._flow = flow

    def add(self, operator: str, *inputs: str, **attributes: object) -> str:
        name = f"face_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [*inputs], [name], **attributes))  # type: ignore[arg-type]
        return name

    def constant(self, value: object, dtype: type = np.float32) -> str:
        name = f"face_c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype), name))
        return name

    def lite(self, left: str, right: str) -> str:
        """Append every graph of a cold step; returns the disparity [1, H, W]."""
        known = {LEFT: left, RIGHT: right}
        known[UVD_CURR_FROM_PREV] = self.constant(np.eye(4)[None])
        for tensor in self._card.state:
            known[tensor.input_name] = self.constant(np.zeros((1, *tensor.shape(*self._size))))
        if self._flow:
            ends = (self.constant([each], np.int64) for each in (0, 1, 1))
            moved = self.add("Slice", self._flow, *ends)
            known[self._card.state[0].input_name] = self.add("Mul", moved, self.constant(-4))
        for stage in self._card.stages(self._iterations):
            for path in stage:
                prefix = f"{path.stem}_"
                part = onnx.compose.add_prefix(onnx.load(path), prefix)
                self.opsets |= {each.domain: each.version for each in part.opset_import}
                self.constants += part.graph.initializer
                for each in part.graph.input:
                    source = known[each.name.removeprefix(prefix)]
                    self.nodes.append(helper.make_node("Identity", [source], [each.name]))
                self.nodes += part.graph.node
                known |= {each.name.removeprefix(prefix): each.name for each in part.graph.output}
        return known[DISPARITY]

    def as_bytes(self, view: str, affine: Affine) -> str:
        mean, std = (self.constant(np.array(each)[None, :, None, None]) for each in affine)
        undone = self.add("Add", self.add("Mul", view, std), mean)
        rounded = self.add("Round", self.add("Clip", undone, self.constant(0), self.constant(255)))
        whole = self.add("Cast", rounded, to=TensorProto.UINT8)
        return self.add("Transpose", whole, perm=[0, 2, 3, 1])

    def model(self, face: Face) -> ModelProto:
        left, right = (self.as_bytes(each, face.affine) for each in face.views(self))
        found = self.lite(left, right)
        result = self.add("Unsqueeze", found, self.constant([1], np.int64))
        result = self.add("Mul", result, self.constant(1 / face.factor))
        height, width = self._size
        shape: Shape = [1, 1, height, width]
        if face.channels_last:
            result, shape = self.add("Transpose", result, perm=[0, 2, 3, 1]), [1, height, width, 1]
        self.nodes.append(helper.make_node("Identity", [result], [face.output]))
        graph = helper.make_graph(
            self.nodes,
            "foreign",
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, each)
                for name, each in face.inputs.items()
            ],
            [helper.make_tensor_value_info(face.output, TensorProto.FLOAT, shape)],
            self.constants,
        )
        opsets = [helper.make_opsetid(*each) for each in self.opsets.items()]
        return helper.make_model(graph, opset_imports=opsets, ir_version=8)
