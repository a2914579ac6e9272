"""A small ONNX graph, written operator by operator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

OPSET = 18  # scatters that keep the largest value, and resizing by axes
IR_VERSION = 8

Shape = Sequence[str | int]


class GraphBuilder:
    """Appends operators; each returns the name of its result."""

    def __init__(self) -> None:
        self._nodes: list[NodeProto] = []
        self._constants: list[TensorProto] = []
        self._names = 0

    def constant(self, value: ArrayLike, dtype: Any) -> str:
        name = self._new_name()
        self._constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def floats(self, value: ArrayLike) -> str:
        return self.constant(value, np.float32)

    def integers(self, value: ArrayLike) -> str:
        return self.constant(value, np.int64)

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Append an operator with one output."""
        name = self._new_name()
        self._nodes.append(helper.make_node(operator, [*inputs], [name], **attributes))
        return name

    def as_float(self, value: str) -> str:
        return self.add("Cast", value, to=TensorProto.FLOAT)

    def dimension(self, value: str, axis: int) -> str:
        """The size along an axis, int64 [1]."""
        return self.add("Shape", value, start=axis, end=axis + 1)

    def returns(self, name: str, value: str) -> None:
        """Give a result the name of an output."""
        self._nodes.append(helper.make_node("Identity", [value], [name]))

    def build(
        self,
        inputs: Mapping[str, tuple[int, Shape]],
        outputs: Mapping[str, tuple[int, Shape]],
    ) -> ModelProto:
        """Return the checked graph; inputs and outputs are element type and shape by name."""
        graph = helper.make_graph(
            self._nodes,
            "vergence",
            [helper.make_tensor_value_info(name, *about) for name, about in inputs.items()],
            [helper.make_tensor_value_info(name, *about) for name, about in outputs.items()],
            self._constants,
        )
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION)
        onnx.checker.check_model(model, full_check=True)
        return model

    def _new_name(self) -> str:
        self._names += 1
        return f"v{self._names}"
