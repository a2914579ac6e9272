"""Graphs in the layouts of published networks. Each really matches, by comparing blocks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from tests.support.block_matcher import matching

HEIGHT, WIDTH = 96, 256
DISPARITIES = 48

# (mean, std) of what the graph expects of bytes.
IMAGENET = ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375))
UNIT = ((0.0,), (255.0,))
BYTES = ((0.0,), (1.0,))
SIGNED = ((127.5,), (127.5,))

Affine = tuple[tuple[float, ...], tuple[float, ...]]
Shape = list[str | int]


class Graph:
    """Nodes and constants; each call returns the name of its result."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [*inputs], [name], **attributes))
        return name

    def give(self, name: str, value: str) -> None:
        self.nodes.append(helper.make_node("Identity", [value], [name]))

    def constant(self, value: object, dtype: type = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype), name))
        return name

    def brightness(self, image: str, affine: Affine, channels: int = 3) -> str:
        """The light of [B, C, H, W], 0 to 255. What the range cannot hold is lost, as in a net."""
        mean, std = (np.array(each, np.float32)[None, :, None, None] for each in affine)
        if channels == 1:
            mean, std = mean.mean(axis=1, keepdims=True), std.mean(axis=1, keepdims=True)
        undone = self.add("Add", self.add("Mul", image, self.constant(std)), self.constant(mean))
        light = self.add("ReduceMean", undone, axes=[1], keepdims=1)
        return self.add("Clip", light, self.constant(0), self.constant(255))

    def match(self, lights: list[str], disparities: int = DISPARITIES) -> str:
        found = f"found{len(self.nodes)}"
        left, right = lights
        prefix = f"m{len(self.nodes)}_"
        nodes, constants = matching(left, right, found, disparities=disparities, prefix=prefix)
        self.nodes += nodes
        self.constants += constants
        return found

    def model(
        self,
        inputs: dict[str, Shape],
        outputs: dict[str, Shape],
        *,
        takes: int = TensorProto.FLOAT,
        returns: int = TensorProto.FLOAT,
    ) -> ModelProto:
        """Opset 13, as most published files."""
        graph = helper.make_graph(
            self.nodes,
            "matcher",
            [helper.make_tensor_value_info(n, takes, s) for n, s in inputs.items()],
            [helper.make_tensor_value_info(n, returns, s) for n, s in outputs.items()],
            self.constants,
        )
        opset = [helper.make_opsetid("", 13)]
        return helper.make_model(graph, opset_imports=opset, ir_version=7)


def two_images(
    left: str,
    right: str,
    output: str,
    affine: Affine,
    *,
    factor: float = 1.0,
    squeezed: bool = False,
    channels_last: bool = False,
    free: bool = False,
    confidence: str = "",
    flow: bool = False,
) -> ModelProto:
    """Two images; the output is the disparity divided by ``factor``."""
    graph = Graph()
    names = [left, right]
    if channels_last:
        names = [graph.add("Transpose", each, perm=[0, 3, 1, 2]) for each in names]
    lights = [graph.brightness(each, affine) for each in names]
    found = graph.match(lights)
    result = graph.add("Mul", found, graph.constant(1 / factor))
    size: Shape = ["H", "W"] if free else [HEIGHT, WIDTH]
    batch: Shape = ["B"] if free else [1]
    shape: Shape = [*batch, 1, *size]
    if flow:  # with a second channel, which is zero
        nothing = graph.add("Sub", result, result)
        result, shape = graph.add("Concat", result, nothing, axis=1), [*batch, 2, *size]
    if squeezed:
        result, shape = graph.add("Squeeze", result, graph.constant([1], np.int64)), batch + size
    graph.give(output, result)
    outputs = {output: shape}
    if confidence:
        sure = graph.add("Mul", found, graph.constant(0))
        graph.give(confidence, graph.add("Add", sure, graph.constant(0.8)))
        outputs[confidence] = [*batch, 1, *size]
    image: Shape = [*batch, *size, 3] if channels_last else [*batch, 3, *size]
    return graph.model({left: image, right: image}, outputs)


def joined(channels: int, *, of_both: bool = False) -> ModelProto:
    """HITNet: both images in one input, and the map in NHWC; ``of_both`` adds the right view's."""
    graph = Graph()
    half = channels // 2
    ends = [graph.constant([each], np.int64) for each in (0, half, channels)]
    axis = graph.constant([1], np.int64)
    views = [graph.add("Slice", "input", ends[i], ends[i + 1], axis) for i in (0, 1)]
    lights = [graph.brightness(each, UNIT, half) for each in views]
    result = graph.add("Transpose", graph.match(lights), perm=[0, 2, 3, 1])
    graph.give("reference_output_disparity", result)
    outputs: dict[str, Shape] = {"reference_output_disparity": [1, HEIGHT, WIDTH, 1]}
    if of_both:
        mirrored = [
            graph.add(
                "Slice",
                each,
                graph.constant([-1], np.int64),
                graph.constant([-WIDTH - 1], np.int64),
                graph.constant([3], np.int64),
                graph.constant([-1], np.int64),
            )
            for each in reversed(lights)
        ]
        graph.give("secondary_output_disparity", graph.match(mirrored))
        outputs["secondary_output_disparity"] = [1, 1, HEIGHT, WIDTH]
    return graph.model({"input": [1, channels, HEIGHT, WIDTH]}, outputs)


def with_halves() -> ModelProto:
    """CREStereo, combined: the half-size pair decides where the other one is searched."""
    graph = Graph()
    halves = [graph.brightness(each, BYTES) for each in ("init_left", "init_right")]
    whole = [graph.brightness(each, BYTES) for each in ("next_left", "next_right")]
    coarse = graph.match(halves, DISPARITIES // 2)
    scales = graph.constant([1, 1, 2, 2])
    twice = graph.add("Resize", coarse, "", scales, mode="nearest")
    coarse_px = graph.add("Mul", twice, graph.constant(2))
    fine = graph.match(whole)
    apart = graph.add("Abs", graph.add("Sub", fine, coarse_px))
    near = graph.add("Less", apart, graph.constant(3))
    found = graph.add("Where", near, fine, coarse_px)
    nothing = graph.add("Sub", found, found)
    graph.give("next_output", graph.add("Concat", found, nothing, axis=1))
    small: Shape = [1, 3, HEIGHT // 2, WIDTH // 2]
    large: Shape = [1, 3, HEIGHT, WIDTH]
    names = {"init_left": small, "init_right": small, "next_left": large, "next_right": large}
    return graph.model(names, {"next_output": [1, 2, HEIGHT, WIDTH]})


@dataclass(frozen=True, slots=True)
class Layout:
    """A published layout, and what is right for it."""

    make: Callable[[], ModelProto]
    pixels: str
    factor: float
    like: str | None = None


GRAPHS = {
    "raft": Layout(
        lambda: two_images("x1", "x2", "output", BYTES, factor=-1), "0..255", -1, "raft-stereo"
    ),
    "raft of any size": Layout(
        lambda: two_images("x1", "x2", "output", BYTES, factor=-1, free=True),
        "0..255",
        -1,
        "raft-stereo",
    ),
    "acvnet": Layout(
        lambda: two_images("input.1", "onnx_2", "17", IMAGENET, squeezed=True),
        "imagenet",
        1,
        "acvnet",
    ),
    "openstereo": Layout(
        lambda: two_images("left_img", "right_img", "disp_pred", IMAGENET, squeezed=True),
        "imagenet",
        1,
        "openstereo",
    ),
    "ess": Layout(
        lambda: two_images(
            "input_left", "input_right", "output_left", SIGNED, confidence="output_conf"
        ),
        "-1..1",
        1,
        "ess",
    ),
    "hitnet": Layout(lambda: joined(6), "0..1", 1, "hitnet"),
    "hitnet of grey images": Layout(lambda: joined(2), "0..1", 1, "hitnet"),
    "hitnet of both views": Layout(lambda: joined(6, of_both=True), "0..1", 1, "hitnet"),
    "crestereo without halves": Layout(
        lambda: two_images("left", "right", "output", BYTES, flow=True), "0..255", 1, "crestereo"
    ),
    "coex": Layout(
        lambda: two_images("left", "right", "disp", IMAGENET, squeezed=True), "imagenet", 1, "coex"
    ),
    "cgi-stereo": Layout(
        lambda: two_images("left", "right", "output", UNIT, squeezed=True), "0..1", 1, "cgi-stereo"
    ),
    "liteanystereo": Layout(
        lambda: two_images("left", "right", "disparity", BYTES, free=True),
        "0..255",
        1,
        "liteanystereo",
    ),
    "foundationstereo": Layout(
        lambda: two_images("left_image", "right_image", "disparity", IMAGENET),
        "imagenet",
        1,
        "foundationstereo",
    ),
    "crestereo": Layout(with_halves, "0..255", 1, "crestereo"),
    "igev": Layout(lambda: two_images("image1", "image2", "disp_up", BYTES), "0..255", 1, "igev"),
    "sixteenths, channels last": Layout(
        lambda: two_images("a", "b", "c", UNIT, factor=1 / 16, channels_last=True),
        "0..1",
        1 / 16,
    ),
}


def written(model: ModelProto, path: Path) -> Path:
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)
    return path


FLOW_CELL_PX = 4
REACH_PX = 6  # an iteration looks this far to either side


def refining(iterations: int, *, flow: bool = True) -> ModelProto:
    """A network that refines a flow, as RAFT-Stereo with flow_init: fewer iterations need one.

    The last iteration compares blocks close to the disparity that it is given. If there is one
    before, it searches everything, in the pixels of both views at half the size.
    """
    graph = Graph()
    left, right = (graph.brightness(each, BYTES) for each in ("image1", "image2"))
    if iterations > 1:
        halves = []
        for each in (left, right):
            small = graph.add("AveragePool", each, kernel_shape=[2, 2], strides=[2, 2])
            halves.append(small)
        coarse = graph.match(halves, DISPARITIES // 2)
        twice = graph.add("Resize", coarse, "", graph.constant([1, 1, 2, 2]), mode="nearest")
        start = graph.add("Mul", twice, graph.constant(2))
    else:
        first, last = (graph.constant([each], np.int64) for each in (0, 1))
        x = graph.add("Slice", "flow_init", first, last, graph.constant([1], np.int64))
        scales = graph.constant([1, 1, FLOW_CELL_PX, FLOW_CELL_PX])
        large = graph.add("Resize", x, "", scales, mode="nearest")
        start = graph.add("Round", graph.add("Mul", large, graph.constant(-FLOW_CELL_PX)))
    columns = graph.constant(np.arange(WIDTH)[None, None, None, :].repeat(HEIGHT, axis=2))
    seen_at = graph.add("Sub", columns, start)
    costs = []
    for step in range(-REACH_PX, REACH_PX + 1):
        at = graph.add("Sub", seen_at, graph.constant(step))
        at = graph.add("Clip", at, graph.constant(0), graph.constant(WIDTH - 1))
        index = graph.add("Cast", at, to=TensorProto.INT64)
        there = graph.add("GatherElements", right, index, axis=3)
        costs.append(graph.add("Abs", graph.add("Sub", left, there)))
    cost = graph.add("Concat", *costs, axis=1)
    pooled = graph.add(
        "AveragePool", cost, kernel_shape=[7, 7], pads=[3, 3, 3, 3], count_include_pad=1
    )
    best = graph.add("Cast", graph.add("ArgMin", pooled, axis=1), to=TensorProto.FLOAT)
    found = graph.add("Add", start, graph.add("Sub", best, graph.constant(REACH_PX)))
    unused = graph.add("Mul", "flow_init", graph.constant(0))  # exporters keep all inputs
    nothing = graph.add("ReduceSum", unused, keepdims=1)
    graph.give("flow_up", graph.add("Sub", nothing, found))
    image: Shape = [1, 3, HEIGHT, WIDTH]
    cells: Shape = [1, 2, HEIGHT // FLOW_CELL_PX, WIDTH // FLOW_CELL_PX]
    return graph.model(
        {"image1": image, "image2": image, "flow_init": cells},
        {"flow_up": [1, 1, HEIGHT, WIDTH]},
    )
