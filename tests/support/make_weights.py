"""Write tests/support/weights: graphs of a few operations each, as models of a manifest.

Run by hand (``python -m tests.support.make_weights``, needs onnx); what it writes is committed, so
that the suite needs no more than the server does.

- ``reciprocal`` divides by brightness: not finite where a pixel of the left image is black.
- ``whole`` remembers, and fails where a pixel of either image is white: one graph per count.
- ``staged`` does the same, operation by operation, in three graphs of two stages.
- ``matcher`` has no memory: it compares blocks of the two images.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper

from tests.support.block_matcher import brightness_of, matching
from vergence_proto.model_io import DISPARITY, LEFT, MANIFEST_FORMAT, MANIFEST_NAME, RIGHT, SIGMA
from vergence_proto.model_io import UVD_CURR_FROM_PREV as MOTION

FOLDER = Path(__file__).parent / "weights"
COUNTS = (1, 2)
MATCHER_DISPARITIES = 16

Shape = list[str | int | None]
_IMAGE: tuple[int, Shape] = (TensorProto.UINT8, ["B", "H", "W", 3])
_PLANE: tuple[int, Shape] = (TensorProto.FLOAT, ["B", "H", "W"])
_STATE: tuple[int, Shape] = (TensorProto.FLOAT, ["B", 1, "H", "W"])
_TENSORS: dict[str, tuple[int, Shape]] = {
    LEFT: _IMAGE,
    RIGHT: _IMAGE,
    MOTION: (TensorProto.FLOAT, ["B", 4, 4]),
    "prev_memory": _STATE,
    "next_memory": _STATE,
    DISPARITY: _PLANE,
    SIGMA: _PLANE,
    "left_light": _PLANE,
    "moved": _PLANE,
}
_INPUTS = (LEFT, RIGHT, MOTION, "prev_memory")
_OUTPUTS = (DISPARITY, SIGMA, "next_memory")
# What light each brightness stands for. There is no 255: to look it up is an error.
_LIGHT = np.sqrt(np.arange(1, 256, dtype=np.float32))


def reciprocal() -> list[NodeProto]:
    """disparity = 1 / brightness of the left image."""
    return [
        helper.make_node("Cast", [LEFT], ["rgb"], to=TensorProto.FLOAT),
        helper.make_node("ReduceSum", ["rgb", "last"], ["brightness"], keepdims=0),
        helper.make_node("Reciprocal", ["brightness"], [DISPARITY]),
        helper.make_node("Identity", [DISPARITY], [SIGMA]),
        helper.make_node("Unsqueeze", [DISPARITY, "first"], ["next_memory"]),
    ]


def light_of(image: str, light: str) -> list[NodeProto]:
    """The mean over the channels of what :data:`_LIGHT` has for their brightness."""
    return [
        helper.make_node("Cast", [image], [f"{image}_index"], to=TensorProto.INT32),
        helper.make_node("Gather", ["light", f"{image}_index"], [f"{image}_lights"]),
        helper.make_node("ReduceMean", [f"{image}_lights", "last"], [light], keepdims=0),
    ]


def move() -> list[NodeProto]:
    """The memory, scaled by the mean of the motion."""
    return [
        helper.make_node("Squeeze", ["prev_memory", "first"], ["memory"]),
        helper.make_node("ReduceMean", [MOTION, "matrix"], ["motion"]),
        helper.make_node("Mul", ["memory", "motion"], ["moved"]),
    ]


def recall(iterations: int) -> list[NodeProto]:
    """disparity = left light / right light + what is remembered, again for every iteration."""
    nodes = [helper.make_node("Div", ["left_light", SIGMA], ["contrast"])]
    memory = "moved"
    for turn in range(iterations):
        nodes.append(helper.make_node("Tanh", [memory], [f"kept_{turn}"]))
        memory = DISPARITY if turn == iterations - 1 else f"memory_{turn}"
        nodes.append(helper.make_node("Add", ["contrast", f"kept_{turn}"], [memory]))
    return [*nodes, helper.make_node("Unsqueeze", [DISPARITY, "first"], ["next_memory"])]


def matcher() -> tuple[list[NodeProto], list[TensorProto]]:
    """disparity = that of the most similar block; sigma = 0.5 px everywhere."""
    light, light_constants = brightness_of([LEFT, RIGHT])
    search, constants = matching(
        f"{LEFT}_light", f"{RIGHT}_light", "found", disparities=MATCHER_DISPARITIES
    )
    nodes = [
        *light,
        *search,
        helper.make_node("Squeeze", ["found", "first"], [DISPARITY]),
        helper.make_node("Mul", [DISPARITY, "nothing"], ["zeros"]),
        helper.make_node("Add", ["zeros", "half"], [SIGMA]),
    ]
    numbers = {"nothing": np.float32(0), "half": np.float32(0.5)}
    return nodes, [
        *light_constants,
        *constants,
        *(numpy_helper.from_array(np.array(value), name) for name, value in numbers.items()),
    ]


def write_graph(
    name: str,
    nodes: list[NodeProto],
    inputs: Sequence[str],
    outputs: Sequence[str],
    own_constants: Sequence[TensorProto] = (),
) -> str:
    """Write a graph to the folder; returns its file's name."""
    constants = [
        helper.make_tensor("last", TensorProto.INT64, [1], [3]),
        helper.make_tensor("first", TensorProto.INT64, [1], [1]),
        helper.make_tensor("matrix", TensorProto.INT64, [2], [1, 2]),
        numpy_helper.from_array(_LIGHT, "light"),
        *own_constants,
    ]
    used = {tensor for node in nodes for tensor in node.input}
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info(each, *_TENSORS[each]) for each in inputs],
        [helper.make_tensor_value_info(each, *_TENSORS[each]) for each in outputs],
        [constant for constant in constants if constant.name in used],
    )
    opset = [helper.make_opsetid("", 18)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    (FOLDER / f"{name}.onnx").write_bytes(model.SerializeToString())
    return f"{name}.onnx"


def entry(
    graphs: dict[int, list[list[str]]], *, memory: bool = True, max_disparity_px: int = 64
) -> dict[str, object]:
    files = sorted({file for stages in graphs.values() for stage in stages for file in stage})
    digests = {file: hashlib.sha256((FOLDER / file).read_bytes()).hexdigest() for file in files}
    return {
        "stride": 1,
        "max_disparity_px": max_disparity_px,
        "state": [{"name": "memory", "channels": 1, "scale": 1}] if memory else [],
        "graphs": {str(count): stages for count, stages in graphs.items()},
        "files": digests,
    }


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    only = write_graph("reciprocal_1", reciprocal(), _INPUTS, _OUTPUTS)
    left_nodes, right_nodes = [*light_of(LEFT, "left_light"), *move()], light_of(RIGHT, SIGMA)
    first_stage = [
        write_graph("left", left_nodes, [LEFT, MOTION, "prev_memory"], ["left_light", "moved"]),
        write_graph("right", right_nodes, [RIGHT], [SIGMA]),
    ]
    whole, staged = {}, {}
    for count in COUNTS:
        last_nodes, last_inputs = recall(count), ["left_light", SIGMA, "moved"]
        all_nodes = [*left_nodes, *right_nodes, *last_nodes]
        whole[count] = [[write_graph(f"whole_{count}", all_nodes, _INPUTS, _OUTPUTS)]]
        last_outputs = [DISPARITY, "next_memory"]
        last = write_graph(f"staged_{count}", last_nodes, last_inputs, last_outputs)
        staged[count] = [first_stage, [last]]
    nodes, constants = matcher()
    blocks = write_graph("matcher_1", nodes, [LEFT, RIGHT], [DISPARITY, SIGMA], constants)
    models = {
        "matcher": entry({1: [[blocks]]}, memory=False, max_disparity_px=MATCHER_DISPARITIES),
        "reciprocal": entry({1: [[only]]}),
        "whole": entry(whole),
        "staged": entry(staged),
    }
    manifest = {"format": MANIFEST_FORMAT, "models": models}
    (FOLDER / MANIFEST_NAME).write_text(json.dumps(manifest, indent=1) + "\n")


if __name__ == "__main__":
    main()
