"""`lite` behind the face of a foreign network, added back: the same bits as `lite` itself."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from tests.support.foreign_graphs import BYTES, IMAGENET, UNIT, Affine, written
from vergence_models.evaluate import WEIGHTS
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import scene
from vergence_proto.geometry import RectifiedRig
from vergence_proto.model_io import (
    DISPARITY,
    LEFT,
    RIGHT,
    UVD_CURR_FROM_PREV,
    ModelCard,
    load_model_card,
)
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

HEIGHT, WIDTH = 96, 192
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 95.5, 95.5, 47.5, 0.1)
ITERATIONS = 1

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
    """The graphs of `lite` for a fixed size, as one graph with another face."""

    def __init__(self, card: ModelCard) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self.opsets: dict[str, int] = {}
        self._card = card

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
            known[tensor.input_name] = self.constant(np.zeros((1, *tensor.shape(HEIGHT, WIDTH))))
        for stage in self._card.stages(ITERATIONS):
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
        shape: Shape = [1, 1, HEIGHT, WIDTH]
        if face.channels_last:
            result, shape = self.add("Transpose", result, perm=[0, 2, 3, 1]), [1, HEIGHT, WIDTH, 1]
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


def halved(graph: Wrapped) -> tuple[str, str]:
    """CREStereo's four images. The small ones are looked at, and change nothing."""
    views = []
    for side in ("left", "right"):
        small = graph.add("ReduceMean", f"init_{side}", keepdims=1)
        nothing = graph.add("Mul", small, graph.constant(0))
        views.append(graph.add("Add", f"next_{side}", nothing))
    return views[0], views[1]


def cut(graph: Wrapped) -> tuple[str, str]:
    ends = [graph.constant([each], np.int64) for each in (0, 3, 6)]
    axis = graph.constant([1], np.int64)
    left, right = (graph.add("Slice", "input", ends[i], ends[i + 1], axis) for i in (0, 1))
    return left, right


def turned(graph: Wrapped) -> tuple[str, str]:
    left, right = (graph.add("Transpose", each, perm=[0, 3, 1, 2]) for each in ("a", "b"))
    return left, right


_LARGE: Shape = [1, 3, HEIGHT, WIDTH]
_SMALL: Shape = [1, 3, HEIGHT // 2, WIDTH // 2]
FACES = {
    "negative": Face(
        {"x1": _LARGE, "x2": _LARGE}, lambda _: ("x1", "x2"), BYTES, "output", -1.0,
        Given(like="raft-stereo"),
    ),
    "normalised, channels last": Face(
        {"a": [1, HEIGHT, WIDTH, 3], "b": [1, HEIGHT, WIDTH, 3]}, turned, IMAGENET, "disp", 1.0,
        Given(pixels="imagenet", factor=1.0),
    ),
    "joined": Face(
        {"input": [1, 6, HEIGHT, WIDTH]}, cut, UNIT, "reference_output_disparity", 1.0,
        Given(like="hitnet"), channels_last=True,
    ),
    "half-size twin": Face(
        {"init_left": _SMALL, "init_right": _SMALL, "next_left": _LARGE, "next_right": _LARGE},
        halved, BYTES, "next_output", 1.0, Given(like="crestereo"),
    ),
}  # fmt: skip


# Proofs of `lite` take seconds; CI has time for all four.
_QUICK = ("negative", "half-size twin")


@pytest.mark.parametrize(
    "kind",
    [kind if kind in _QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in FACES],
)
def test_lite_behind_a_foreign_face_gives_the_bits_of_lite(kind: str, tmp_path: Path) -> None:
    face = FACES[kind]
    card = load_model_card(WEIGHTS, "lite")
    path = written(Wrapped(card).model(face), tmp_path / "theirs.onnx")
    added = add_model({1: path}, tmp_path, name="lite-of-others", given=face.given)
    assert added.contract.factor == face.factor
    foreign, own = (
        OnnxStereoModel(folder, name, providers=["cpu"], threads=1, allow_spinning=False)
        for folder, name in ((tmp_path, "lite-of-others"), (WEIGHTS, "lite"))
    )
    for seed in (1, 2):
        pair = scene(HEIGHT, WIDTH, 7, 30, seed=seed)
        step = Step(StereoView(pair.left, pair.right, RIG, 1), None, ITERATIONS)
        [theirs], [ours] = foreign.step([step]), own.step([step])
        np.testing.assert_array_equal(theirs.offset_px, ours.offset_px)
