"""The graphs before and after a foreign graph, which make it a model of the manifest.

A step has three stages: the graph before turns a pair of bytes into what the foreign graph expects,
the foreign graph runs as it is, with the names of its tensors changed, and the graph after turns
its output into disparity and sigma. Three stages, not one graph: then the foreign graph may have
any opset, and its weights are not touched.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import onnx
from onnx import ModelProto, TensorProto

from vergence_models.foreign.contract import PIXELS, Contract, Layout
from vergence_models.foreign.graphs import GraphBuilder, Shape
from vergence_models.foreign.warp_graph import moved_disparity
from vergence_proto.model_io import DISPARITY, LEFT, RIGHT, SIGMA, UVD_CURR_FROM_PREV, StateTensor

NETWORK = "network_"  # before the names of the foreign graph's tensors
MIRRORED = "mirrored_"  # before those of its second run, on the pair seen in a mirror

# Sigma where nothing is known, for example left of the second view: the largest that `lite` gives.
UNSEEN_PX = 27.0
_LEAST_DEPTH = 1e-6
# Beyond these, a probability to be right within a pixel gives no finite sigma.
_CERTAIN = 0.9999

_TYPES = {
    "float32": TensorProto.FLOAT,
    "float16": TensorProto.FLOAT16,
    "uint8": TensorProto.UINT8,
}
_GREY = (0.299, 0.587, 0.114)  # as OpenCV, which the published demos use
_IMAGE: tuple[int, Shape] = (TensorProto.UINT8, ["B", "H", "W", 3])
_PLANE: tuple[int, Shape] = (TensorProto.FLOAT, ["B", "H", "W"])
_MATRIX: tuple[int, Shape] = (TensorProto.FLOAT, ["B", 4, 4])


def state_of(contract: Contract) -> tuple[StateTensor, ...]:
    """The recurrent state of a model with this contract."""
    warm = contract.warm_start
    if warm is None or not warm.used:
        return ()
    return (StateTensor("disparity", channels=1, scale=warm.scale),)


def renamed(network: ModelProto, prefix: str) -> ModelProto:
    """The foreign graph, whose tensors cannot be confused with those of the contract."""
    return onnx.compose.add_prefix(network, prefix)


def graph_before(contract: Contract) -> ModelProto:
    """From the inputs of the contract to those of the foreign graph, and of its mirrored run."""
    graph = GraphBuilder()
    inputs = {LEFT: _IMAGE, RIGHT: _IMAGE}
    outputs: dict[str, tuple[int, Shape]] = {}
    views = {side: _floats_of(graph, contract, side) for side in (LEFT, RIGHT)}
    _feed(graph, contract, views, NETWORK, outputs)
    if contract.sigma == "left-right":
        flipped = {LEFT: _mirror(graph, views[RIGHT], 3), RIGHT: _mirror(graph, views[LEFT], 3)}
        _feed(graph, contract, flipped, MIRRORED, outputs)
    if contract.warm_start is not None and not contract.recurrent:
        _feed_nothing(graph, contract, views[LEFT], outputs)
    for tensor in state_of(contract):
        inputs |= {
            UVD_CURR_FROM_PREV: _MATRIX,
            tensor.input_name: (TensorProto.FLOAT, ["B", 1, "h", "w"]),
        }
        _feed_flow(graph, contract, tensor, outputs)
    return graph.build(inputs, outputs)


def graph_after(contract: Contract) -> ModelProto:
    """From the foreign graph's outputs to disparity, sigma and the next state."""
    graph = GraphBuilder()
    inputs: dict[str, tuple[int, Shape]] = {LEFT: _IMAGE}
    outputs = {DISPARITY: _PLANE, SIGMA: _PLANE}
    found = _disparity_of(graph, contract, NETWORK, inputs)
    graph.returns(DISPARITY, found)
    graph.returns(SIGMA, _sigma_of(graph, contract, found, inputs))
    for tensor in state_of(contract):
        scale = tensor.scale
        # The pixel in the middle of each cell. A mean would invent surfaces at every edge.
        starts, steps = graph.integers([scale // 2] * 2), graph.integers([scale] * 2)
        ends, axes = graph.integers([2**31] * 2), graph.integers([1, 2])
        cells = graph.add("Slice", found, starts, ends, axes, steps)
        graph.returns(tensor.output_name, graph.add("Unsqueeze", cells, graph.integers([1])))
        outputs[tensor.output_name] = (TensorProto.FLOAT, ["B", 1, "h", "w"])
    return graph.build(inputs, outputs)


def _floats_of(graph: GraphBuilder, contract: Contract, image: str) -> str:
    """The pixels of an image as the graph wants them: float [B, C, h, w]."""
    pixels = graph.as_float(image)
    if contract.order == "bgr":
        pixels = graph.add("Gather", pixels, graph.integers([2, 1, 0]), axis=3)
    elif contract.order == "grey":
        shares = graph.floats(_GREY)
        weighted = graph.add("Mul", pixels, shares)
        pixels = graph.add("ReduceSum", weighted, graph.integers([3]), keepdims=1)
    affine = PIXELS[contract.pixels]
    mean, std = affine.mean, affine.std
    if contract.order == "grey":
        mean, std = ((sum(each) / len(each),) for each in (mean, std))
    elif contract.order == "bgr":
        mean, std = mean[::-1], std[::-1]
    if any(mean):
        pixels = graph.add("Sub", pixels, graph.floats(mean))
    if any(each != 1 for each in std):
        pixels = graph.add("Div", pixels, graph.floats(std))
    pixels = graph.add("Transpose", pixels, perm=[0, 3, 1, 2])
    return pixels if contract.size is None else _resized(graph, pixels, contract.size)


def _feed(
    graph: GraphBuilder,
    contract: Contract,
    views: dict[str, str],
    prefix: str,
    outputs: dict[str, tuple[int, Shape]],
) -> None:
    """Name the images as the inputs of the foreign graph."""
    first, second = (RIGHT, LEFT) if contract.swapped else (LEFT, RIGHT)
    axis = 3 if contract.channels_last else 1

    def give(name: str, value: str, channels: int) -> None:
        if contract.channels_last:
            value = graph.add("Transpose", value, perm=[0, 2, 3, 1])
        kind = _TYPES[contract.dtype]
        if kind != TensorProto.FLOAT:
            value = graph.add("Cast", value, to=kind)
        graph.returns(prefix + name, value)
        shape: list[str | int] = ["B", "y", "x"]
        shape.insert(axis, channels)
        outputs[prefix + name] = kind, shape

    if not contract.right:
        both = graph.add("Concat", views[first], views[second], axis=1)
        give(contract.left, both, 2 * contract.channels)
        return
    give(contract.left, views[first], contract.channels)
    give(contract.right, views[second], contract.channels)
    if contract.left_half:
        scales = graph.floats([1, 1, 0.5, 0.5])
        for name, side in ((contract.left_half, first), (contract.right_half, second)):
            half = graph.add("Resize", views[side], "", scales, mode="linear")
            kind, shape = outputs[prefix + contract.left]
            give(name, half, contract.channels)
            outputs[prefix + name] = kind, [f"half_{d}" if d in ("x", "y") else d for d in shape]


def _feed_nothing(
    graph: GraphBuilder, contract: Contract, view: str, outputs: dict[str, tuple[int, Shape]]
) -> None:
    """An initial flow of zeros: the graph starts as it does without one."""
    warm = contract.warm_start
    assert warm is not None
    batch = graph.add("Shape", view, start=0, end=1)
    size = graph.add("Shape", view, start=2, end=4)
    cells = graph.add("Div", size, graph.integers([warm.scale]))
    shape = graph.add("Concat", batch, graph.integers([warm.channels]), cells, axis=0)
    zeros = graph.add("Expand", graph.floats(0), shape)
    prefixes = (NETWORK, MIRRORED) if contract.sigma == "left-right" else (NETWORK,)
    for prefix in prefixes:
        graph.returns(prefix + warm.input, zeros)
        outputs[prefix + warm.input] = TensorProto.FLOAT, ["B", warm.channels, "fy", "fx"]


def _feed_flow(
    graph: GraphBuilder,
    contract: Contract,
    tensor: StateTensor,
    outputs: dict[str, tuple[int, Shape]],
) -> None:
    warm = contract.warm_start
    assert warm is not None
    moved = moved_disparity(graph, tensor.input_name, UVD_CURR_FROM_PREV, scale=tensor.scale)
    factor = graph.floats(warm.factor)
    if contract.size is not None:
        height, width = contract.size
        cells = (height // warm.scale, width // warm.scale)
        seen = graph.dimension(moved, 3)
        ratio = graph.add("Div", graph.floats([cells[1]]), graph.as_float(seen))
        factor = graph.add("Mul", factor, ratio)
        moved = _resized(graph, moved, cells, mode="nearest")
    flow = graph.add("Mul", moved, factor)
    if warm.channels == 2:
        flow = graph.add("Concat", flow, graph.add("Sub", flow, flow), axis=1)
    graph.returns(NETWORK + warm.input, flow)
    outputs[NETWORK + warm.input] = TensorProto.FLOAT, ["B", warm.channels, "fy", "fx"]
    if contract.sigma == "left-right":  # it starts from nothing: its view was never seen before
        graph.returns(MIRRORED + warm.input, graph.add("Sub", flow, flow))
        outputs[MIRRORED + warm.input] = outputs[NETWORK + warm.input]


def _resized(
    graph: GraphBuilder,
    planes: str,
    size: tuple[int, int],
    *,
    mode: Literal["linear", "nearest"] = "linear",
) -> str:
    """[B, C, h, w] resized; smaller images are means of all their pixels."""
    antialias = {"antialias": 1} if mode == "linear" else {}
    sizes = _sizes(graph, planes, graph.integers(size))
    return graph.add("Resize", planes, "", "", sizes, mode=mode, **antialias)


def _sizes(graph: GraphBuilder, planes: str, size: str) -> str:
    """All four sizes. With only two and axes, onnxruntime's optimizer spoils some graphs."""
    first = graph.add("Shape", planes, start=0, end=2)
    return graph.add("Concat", first, size, axis=0)


def _mirror(graph: GraphBuilder, planes: str, axis: int) -> str:
    last, before_first = graph.integers([-1]), graph.integers([-(2**31)])
    along, backwards = graph.integers([axis]), graph.integers([-1])
    return graph.add("Slice", planes, last, before_first, along, backwards)


def _plane_of(graph: GraphBuilder, value: str, layout: Layout, channel: int) -> str:
    """One channel of an output as float [B, h, w]."""
    value = graph.as_float(value)
    if layout == "HW":
        return graph.add("Unsqueeze", value, graph.integers([0]))
    if layout == "NHW":
        return value
    picked = graph.constant(channel, "int64")
    return graph.add("Gather", value, picked, axis=1 if layout == "NCHW" else 3)


def _shape_of(layout: Layout, prefix: str) -> list[str | int]:
    return [f"{prefix}{axis}" for axis in layout]


def _at_image_size(graph: GraphBuilder, plane: str) -> tuple[str, str]:
    """Resize [B, h, w] to the image; return it with the image's width by its own, float [1]."""
    height, width = graph.dimension(LEFT, 1), graph.dimension(LEFT, 2)
    own = graph.as_float(graph.dimension(plane, 2))
    ratio = graph.add("Div", graph.as_float(width), own)
    size = graph.add("Concat", height, width, axis=0)
    one = graph.integers([1])
    planes = graph.add("Unsqueeze", plane, one)
    sizes = _sizes(graph, planes, size)
    planes = graph.add("Resize", planes, "", "", sizes, mode="linear")
    return graph.add("Squeeze", planes, one), ratio


def _disparity_of(
    graph: GraphBuilder, contract: Contract, prefix: str, inputs: dict[str, tuple[int, Shape]]
) -> str:
    """Disparity [B, H, W] in pixels of the image."""
    name = prefix + contract.output
    kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(contract.output_dtype))
    inputs[name] = kind, _shape_of(contract.output_layout, prefix)
    plane = _plane_of(graph, name, contract.output_layout, contract.output_channel)
    if contract.of_depth:
        plane = _divisor(graph, plane)
        plane = graph.add("Div", graph.floats(contract.factor), plane)
    elif contract.factor != 1:
        plane = graph.add("Mul", plane, graph.floats(contract.factor))
    if contract.of_width:
        plane = graph.add("Mul", plane, graph.as_float(graph.dimension(LEFT, 2)))
    if contract.size is not None or contract.output_scale != 1:
        plane, ratio = _at_image_size(graph, plane)
        if contract.size is not None:
            scale = graph.floats(contract.output_scale)
            plane = graph.add("Mul", plane, graph.add("Mul", ratio, scale))
    return plane


def _divisor(graph: GraphBuilder, depth: str) -> str:
    """A depth without zeros; what is closer than any camera sees gets the nearest there is."""
    least = graph.floats(_LEAST_DEPTH)
    away = graph.add("Max", graph.add("Abs", depth), least)
    behind = graph.add("Less", depth, graph.floats(0))
    return graph.add("Where", behind, graph.add("Neg", away), away)


def _sigma_of(
    graph: GraphBuilder, contract: Contract, found: str, inputs: dict[str, tuple[int, Shape]]
) -> str:
    """Sigma [B, H, W]: wide where the second view cannot show the point."""
    width = graph.add("Squeeze", graph.dimension(found, 2), graph.integers([0]))
    zero, step = graph.constant(0, "int64"), graph.constant(1, "int64")
    columns = graph.as_float(graph.add("Range", zero, width, step))
    seen_at = graph.add("Sub", columns, found)  # the column of the right view, [B, H, W]
    unseen = graph.add("Less", seen_at, graph.floats(-0.5))
    if contract.sigma == "confidence":
        name = NETWORK + contract.confidence
        kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(contract.output_dtype))
        inputs[name] = kind, _shape_of(contract.confidence_layout, "c")
        certainty = _plane_of(graph, name, contract.confidence_layout, 0)
        if contract.size is not None or contract.output_scale != 1:
            certainty, _ = _at_image_size(graph, certainty)
        # A confidence is the chance to be right within a pixel: 1 - exp(-1 / sigma).
        bounded = graph.add("Clip", certainty, graph.floats(0), graph.floats(_CERTAIN))
        surprise = graph.add("Log", graph.add("Sub", graph.floats(1), bounded))
        least = graph.floats(1 / UNSEEN_PX)
        sigma = graph.add("Reciprocal", graph.add("Max", graph.add("Neg", surprise), least))
    elif contract.sigma == "left-right":
        back = _mirror(graph, _disparity_of(graph, contract, MIRRORED, inputs), 2)
        last = graph.add("Sub", graph.as_float(width), graph.floats(1))
        within = graph.add("Min", graph.add("Relu", graph.add("Round", seen_at)), last)
        index = graph.add("Cast", within, to=TensorProto.INT64)
        theirs = graph.add("GatherElements", back, index, axis=2)
        apart = graph.add("Abs", graph.add("Sub", found, theirs))
        sigma = graph.add("Add", apart, graph.floats(contract.sigma_px))
        sigma = graph.add("Min", sigma, graph.floats(UNSEEN_PX))
    else:
        nothing = graph.add("Mul", found, graph.floats(0))
        sigma = graph.add("Add", nothing, graph.floats(contract.sigma_px))
    return graph.add("Where", unseen, graph.floats(UNSEEN_PX), sigma)
