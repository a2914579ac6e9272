"""Write tests/support/weights: a graph of three operations that divides by brightness.

Run by hand (``python -m tests.support.make_weights``, needs onnx); what it writes is committed, so
that the suite needs no more than the server does.
"""

import hashlib
import json
from pathlib import Path

import onnx
from onnx import TensorProto, helper

from vergence_proto.model_io import DISPARITY, LEFT, MANIFEST_FORMAT, MANIFEST_NAME, RIGHT, SIGMA
from vergence_proto.model_io import UVD_CURR_FROM_PREV as MOTION

FOLDER = Path(__file__).parent / "weights"


def make_graph() -> onnx.ModelProto:
    """disparity = 1 / brightness of the left image: not finite where a pixel is black."""
    image: list[str | int | None] = ["B", "H", "W", 3]
    plane: list[str | int | None] = ["B", "H", "W"]
    state: list[str | int | None] = ["B", 1, "H", "W"]
    motion: list[str | int | None] = ["B", 4, 4]
    nodes = [
        helper.make_node("Cast", [LEFT], ["rgb"], to=TensorProto.FLOAT),
        helper.make_node("ReduceSum", ["rgb", "last"], ["brightness"], keepdims=0),
        helper.make_node("Reciprocal", ["brightness"], [DISPARITY]),
        helper.make_node("Identity", [DISPARITY], [SIGMA]),
        helper.make_node("Unsqueeze", [DISPARITY, "first"], ["next_memory"]),
    ]
    inputs = [
        helper.make_tensor_value_info(LEFT, TensorProto.UINT8, image),
        helper.make_tensor_value_info(RIGHT, TensorProto.UINT8, image),
        helper.make_tensor_value_info(MOTION, TensorProto.FLOAT, motion),
        helper.make_tensor_value_info("prev_memory", TensorProto.FLOAT, state),
    ]
    outputs = [
        helper.make_tensor_value_info(DISPARITY, TensorProto.FLOAT, plane),
        helper.make_tensor_value_info(SIGMA, TensorProto.FLOAT, plane),
        helper.make_tensor_value_info("next_memory", TensorProto.FLOAT, state),
    ]
    constants = [
        helper.make_tensor("last", TensorProto.INT64, [1], [3]),
        helper.make_tensor("first", TensorProto.INT64, [1], [1]),
    ]
    graph = helper.make_graph(nodes, "reciprocal", inputs, outputs, constants)
    opset = [helper.make_opsetid("", 18)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    content = make_graph().SerializeToString()
    (FOLDER / "reciprocal_1.onnx").write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    entry = {
        "stride": 1,
        "max_disparity_px": 64,
        "state": [{"name": "memory", "channels": 1, "scale": 1}],
        "graphs": {"1": {"file": "reciprocal_1.onnx", "sha256": digest}},
    }
    manifest = {"format": MANIFEST_FORMAT, "models": {"reciprocal": entry}}
    (FOLDER / MANIFEST_NAME).write_text(json.dumps(manifest, indent=1) + "\n")


if __name__ == "__main__":
    main()
