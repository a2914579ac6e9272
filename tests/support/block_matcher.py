"""A small stereo network that really matches, as operators of an ONNX graph.

It compares blocks of brightness and returns the whole-pixel disparity of the best one. Its volume
and its decision are those of published networks, so it is as sensitive as they are to a wrong
order, sign, scale or range of the pixels.
"""

from collections.abc import Sequence

import numpy as np
from onnx import NodeProto, TensorProto, helper, numpy_helper

BLOCK = 7


def matching(
    left: str, right: str, found: str, *, disparities: int, prefix: str = ""
) -> tuple[list[NodeProto], list[TensorProto]]:
    """The operators from brightness [B, 1, H, W] of two views, 0 to 255, to float [B, 1, H, W].

    A larger disparity costs a little, which decides where nothing differs: flat regions get 0.
    """

    def name(of: str) -> str:
        return f"{prefix}{of}"

    half = BLOCK // 2
    constants = {
        "before": np.array([0, 0, 0, disparities - 1, 0, 0, 0, 0], np.int64),
        "columns": np.array([3], np.int64),
        "price": 0.05 * np.arange(disparities, dtype=np.float32)[None, :, None, None],
        "no_end": np.array([2**31], np.int64),
    }
    nodes = [helper.make_node("Pad", [right, name("before")], [name("wide")], mode="edge")]
    moved = []
    for d in range(disparities):
        constants[f"from_{d}"] = np.array([disparities - 1 - d], np.int64)
        end = name("no_end")
        if d:
            constants[f"until_{d}"] = np.array([-d], np.int64)
            end = name(f"until_{d}")
        moved.append(name(f"moved_{d}"))
        inputs = [name("wide"), name(f"from_{d}"), end, name("columns")]
        nodes.append(helper.make_node("Slice", inputs, [moved[-1]]))
    pads = [half] * 4
    nodes += [
        helper.make_node("Concat", moved, [name("views")], axis=1),
        helper.make_node("Sub", [left, name("views")], [name("signed")]),
        helper.make_node("Abs", [name("signed")], [name("difference")]),
        helper.make_node(
            "AveragePool",
            [name("difference")],
            [name("cost")],
            kernel_shape=[BLOCK, BLOCK],
            pads=pads,
            count_include_pad=1,
        ),
        helper.make_node("Add", [name("cost"), name("price")], [name("priced")]),
        helper.make_node("ArgMin", [name("priced")], [name("best")], axis=1),
        helper.make_node("Cast", [name("best")], [found], to=TensorProto.FLOAT),
    ]
    return nodes, [numpy_helper.from_array(value, name(key)) for key, value in constants.items()]


def brightness_of(images: Sequence[str]) -> tuple[list[NodeProto], list[TensorProto]]:
    """From uint8 images [B, H, W, 3] to the mean of their channels, NAME_light [B, 1, H, W]."""
    nodes = []
    for image in images:
        nodes += [
            helper.make_node("Cast", [image], [f"{image}_float"], to=TensorProto.FLOAT),
            helper.make_node("ReduceMean", [f"{image}_float", "channels"], [f"{image}_mean"]),
            helper.make_node("Transpose", [f"{image}_mean"], [f"{image}_light"], perm=[0, 3, 1, 2]),
        ]
    return nodes, [numpy_helper.from_array(np.array([3], np.int64), "channels")]
