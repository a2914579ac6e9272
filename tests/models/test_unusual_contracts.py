"""Graphs in layouts that nobody has published: they are understood, or refused with what to do."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx import ModelProto, TensorProto

from tests.support.foreign_graphs import (
    BYTES,
    DISPARITIES,
    HEIGHT,
    IMAGENET,
    UNIT,
    WIDTH,
    Graph,
    Shape,
    written,
)
from vergence_models.foreign.adding import Added, add_model, check_model
from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import scene
from vergence_proto.geometry import RectifiedRig
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

IMAGE: Shape = [1, 3, HEIGHT, WIDTH]
MAP: Shape = [1, 1, HEIGHT, WIDTH]
ANY_SIZE: Shape = ["B", 3, "H", "W"]


def the_right_one_first() -> ModelProto:
    graph = Graph()
    graph.give("y:0", graph.match([graph.brightness(each, IMAGENET) for each in ("zwei", "eins")]))
    return graph.model({"eins": IMAGE, "zwei": IMAGE}, {"y:0": MAP})


def the_fourth_of_six_channels() -> ModelProto:
    graph = Graph()
    views = [graph.add("Transpose", each, perm=[0, 3, 1, 2]) for each in ("cam/l:0", "cam/r:0")]
    found = graph.match([graph.brightness(each, UNIT) for each in views])
    zero = graph.add("Mul", found, graph.constant(0))
    all_six = graph.add("Concat", zero, zero, zero, found, zero, zero, axis=1)
    graph.give("Identity:0", graph.add("Transpose", all_six, perm=[0, 2, 3, 1]))
    last: Shape = [1, HEIGHT, WIDTH, 3]
    return graph.model({"cam/l:0": last, "cam/r:0": last}, {"Identity:0": [1, HEIGHT, WIDTH, 6]})


def halves() -> ModelProto:
    graph = Graph()
    views = [graph.add("Cast", each, to=TensorProto.FLOAT) for each in ("left", "right")]
    found = graph.match([graph.brightness(each, UNIT) for each in views])
    graph.give("disp", graph.add("Cast", found, to=TensorProto.FLOAT16))
    kind = TensorProto.FLOAT16
    return graph.model({"left": IMAGE, "right": IMAGE}, {"disp": MAP}, takes=kind, returns=kind)


def bytes_to_whole_sixteenths() -> ModelProto:
    """As cameras with a chip for stereo: bytes in, a squeezed map of whole numbers out."""
    graph = Graph()
    views = [graph.add("Cast", each, to=TensorProto.FLOAT) for each in ("L", "R")]
    found = graph.match([graph.brightness(each, BYTES) for each in views])
    plane = graph.add("Squeeze", found, graph.constant([0, 1], np.int64))
    whole = graph.add("Mul", plane, graph.constant(16))
    graph.give("D", graph.add("Cast", whole, to=TensorProto.INT32))
    inputs: dict[str, Shape] = {"L": IMAGE, "R": IMAGE}
    takes, returns = TensorProto.UINT8, TensorProto.INT32
    return graph.model(inputs, {"D": [HEIGHT, WIDTH]}, takes=takes, returns=returns)


def a_share_of_the_width() -> ModelProto:
    graph = Graph()
    found = graph.match([graph.brightness(each, BYTES) for each in ("left", "right")])
    third, fourth = (graph.constant([axis], np.int64) for axis in (3, 4))
    width = graph.add("Slice", graph.add("Shape", "left"), third, fourth)
    width = graph.add("Cast", width, to=TensorProto.FLOAT)
    graph.give("disp", graph.add("Div", found, width))
    return graph.model({"left": ANY_SIZE, "right": ANY_SIZE}, {"disp": ["B", 1, "H", "W"]})


def a_depth() -> ModelProto:
    graph = Graph()
    found = graph.match([graph.brightness(each, BYTES) for each in ("left", "right")])
    near = graph.add("Max", found, graph.constant(0.1))
    graph.give("depth", graph.add("Div", graph.constant(20), near))
    return graph.model({"left": IMAGE, "right": IMAGE}, {"depth": MAP})


def another_map_first() -> ModelProto:
    graph = Graph()
    found = graph.match([graph.brightness(each, BYTES) for each in ("left", "right")])
    graph.give("p", graph.add("Mul", "left", graph.constant(0.5)))
    graph.give("q", found)
    return graph.model({"left": IMAGE, "right": IMAGE}, {"p": IMAGE, "q": MAP})


UNDERSTOOD: dict[str, tuple[Callable[[], ModelProto], Callable[[Contract], bool]]] = {
    "the right image first": (the_right_one_first, lambda c: c.swapped),
    "six channels": (the_fourth_of_six_channels, lambda c: c.output_channel == 3),
    "float16": (halves, lambda c: c.dtype == c.output_dtype == "float16"),
    "bytes": (bytes_to_whole_sixteenths, lambda c: c.factor == 1 / 16 and c.dtype == "uint8"),
    "a share of the width": (a_share_of_the_width, lambda c: c.of_width and c.factor == 1),
    "a depth": (a_depth, lambda c: c.of_depth and c.factor == pytest.approx(20)),
    "another map first": (another_map_first, lambda c: c.output == "q"),
}


@pytest.mark.parametrize(("make", "understood"), UNDERSTOOD.values(), ids=UNDERSTOOD)
def test_an_unusual_layout_is_understood_and_served(
    make: Callable[[], ModelProto], understood: Callable[[Contract], bool], tmp_path: Path
) -> None:
    added = add(tmp_path, make())
    assert understood(added.contract), added.contract.words()
    assert check_model(tmp_path, "net").proof is not None
    # Also in images of another width than those of the proof.
    for width in (WIDTH, 2 * WIDTH):
        if width != WIDTH and added.contract.size is not None:
            continue
        pair = scene(HEIGHT, width, 6, 30, seed=1)
        rig = RectifiedRig(width, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)
        model = OnnxStereoModel(tmp_path, "net", providers=["cpu"], threads=1, allow_spinning=False)
        [result] = model.step([Step(StereoView(pair.left, pair.right, rig, 1), None, 1)])
        known = np.isfinite(pair.truth_px)
        assert np.mean(np.abs(result.offset_px - pair.truth_px)[known] <= 1) > 0.95
        assert np.isfinite(result.offset_px).all()


def test_a_depth_is_refused_where_the_user_says_disparity(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match=r"^depth: the output is .* for 40 px .* a depth$"):
        add(tmp_path, a_depth(), factor=1.0)


def test_a_scale_that_is_right_for_one_width_only_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match=r"factor is 1 x the width of the image, not 384$"):
        add(tmp_path, a_share_of_the_width(), factor=384.0)


@pytest.mark.parametrize(
    "shapes",
    [
        {
            f"{side}{scale}": [1, 3, 96 // scale, 256 // scale]
            for scale in (1, 2, 4)
            for side in "lr"
        },
        {"pair": [2, 3, 96, 256]},
        {"pair": [1, 2, 3, 96, 256]},
        {"left": [3, 96, 256], "right": [3, 96, 256]},
    ],
    ids=["three sizes", "both in the batch", "five axes", "no batch"],
)
def test_images_in_a_form_that_is_not_served_are_refused_with_what_to_do(
    shapes: dict[str, Shape], tmp_path: Path
) -> None:
    graph = Graph()
    parts = [graph.add("ReduceMean", each, keepdims=0) for each in shapes]
    graph.give("disp", graph.add("Max", *parts))
    with pytest.raises(ContractError, match=r"^expected .* takes two images \[B, 3, H, W\]"):
        add(tmp_path, graph.model(shapes, {"disp": []}))


def add(folder: Path, model: ModelProto, **given: float) -> Added:
    path = written(model, folder / "theirs.of-others")
    return add_model(
        {1: path},
        folder,
        name="net",
        given=Given(max_disparity_px=DISPARITIES, **given),  # type: ignore[arg-type]
    )
