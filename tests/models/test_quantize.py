"""Laws of int8 graphs: near the float ones, bytes where it pays, a loss that is measured."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from tests.support.wall_clips import wall_clips
from vergence_models.config import StepKind
from vergence_models.data.clips import StereoClips
from vergence_models.data.pool import ClipPool, write_shard
from vergence_models.onnx_export.calibrate import (
    MAX_LOSS,
    RANGE_CLIPS,
    QuantizationError,
    make_int8,
    scales_of,
    steps,
)
from vergence_models.onnx_export.quantization_plan import QuantizationPlan, plan_quantization
from vergence_models.onnx_export.quantize import ByteScale, quantized, with_weights_apart
from vergence_proto.model_io import StateTensor

STATES = (StateTensor("disparity", 1, 4),)
WALL_PX = 12.0  # of the clips


def wall_model(*, outlier: float = 0.0) -> ModelProto:
    """A step by the contract that answers the wall's disparity, and a little of the image.

    Its features are rectified convolutions with a sum. ``outlier`` is added to a channel of theirs
    and taken away again, which costs a byte all that is small.
    """
    random = np.random.default_rng(0)

    def weight(*shape: int) -> NDArray[np.float32]:
        return random.normal(0, 1 / np.sqrt(np.prod(shape[1:])), shape).astype(np.float32)

    answer = np.zeros((1, 16, 3, 3), np.float32)
    answer[0, :, 1, 1] = 0.05
    answer[0, 15, 1, 1] = 1.0
    start = np.zeros(16, np.float32)
    start[15] = outlier
    constants: dict[str, NDArray[Any]] = {
        "patch.weight": weight(8, 3, 4, 4) / 128,
        "first.weight": weight(16, 8, 3, 3),
        "second.weight": weight(16, 16, 3, 3) * (np.arange(16) < 15)[:, None, None, None],
        "second.bias": start,
        "answer.weight": answer,
        "answer.bias": np.array([WALL_PX - outlier], np.float32),
        "four": np.array([1, 1, 4, 4], np.float32),
        "channel": np.array([1], np.int64),
        "patch.bias": np.full(8, 0.1, np.float32),
        "first.bias": np.zeros(16, np.float32),
    }
    three = {"pads": [1, 1, 1, 1]}

    def node(op: str, inputs: str, output: str, **attributes: Any) -> NodeProto:
        return helper.make_node(op, inputs.split(), [output], **attributes)

    nodes = [
        node("Cast", "left", "real", to=TensorProto.FLOAT),
        node("Transpose", "real", "image", perm=[0, 3, 1, 2]),
        node("Conv", "image patch.weight patch.bias", "patches", strides=[4, 4]),
        node("Relu", "patches", "features"),
        node("Conv", "features first.weight first.bias", "a", **three),
        node("Relu", "a", "a_positive"),
        node("Conv", "a_positive second.weight second.bias", "b", **three),
        node("Add", "b a_positive", "both"),
        node("Relu", "both", "both_positive"),
        node("Conv", "both_positive answer.weight answer.bias", "next_disparity", **three),
    ]
    nodes += [
        helper.make_node("Resize", ["next_disparity", "", "four"], ["large"], mode="nearest"),
        node("Squeeze", "large channel", "disparity"),
    ]
    image: list[str | int | None] = ["B", "H", "W", 3]
    inputs = [
        helper.make_tensor_value_info("left", TensorProto.UINT8, image),
        helper.make_tensor_value_info("right", TensorProto.UINT8, image),
        helper.make_tensor_value_info("uvd_curr_from_prev", TensorProto.FLOAT, ["B", 4, 4]),
        helper.make_tensor_value_info("prev_disparity", TensorProto.FLOAT, ["B", 1, "h", "w"]),
    ]
    outputs = [
        helper.make_tensor_value_info("disparity", TensorProto.FLOAT, ["B", "H", "W"]),
        helper.make_tensor_value_info("next_disparity", TensorProto.FLOAT, ["B", 1, "h", "w"]),
    ]
    kept = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "wall", inputs, outputs, kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    return model


def answer_of(model: ModelProto) -> NDArray[np.float32]:
    clips = wall_clips(1)
    left, right = (image.numpy() for image in clips.pair(0))
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    feeds = {
        "left": left,
        "right": right,
        "uvd_curr_from_prev": np.eye(4, dtype=np.float32)[None],
        "prev_disparity": np.zeros((1, 1, left.shape[1] // 4, left.shape[2] // 4), np.float32),
    }
    disparity: NDArray[np.float32] = session.run(["disparity"], feeds)[0]
    return disparity


def found_scales(
    model: ModelProto, what: QuantizationPlan, clips: StereoClips
) -> dict[str, ByteScale]:
    return scales_of(steps(model, STATES, clips, what.measured), what.measured)


@pytest.fixture
def pool(tmp_path: Path) -> ClipPool:
    write_shard(tmp_path / "pool" / "shard_1_000000", wall_clips(RANGE_CLIPS + 2))
    return ClipPool(tmp_path / "pool")


def test_an_int8_graph_answers_nearly_the_same() -> None:
    model = wall_model()
    what = plan_quantization(model)
    scales = found_scales(model, what, wall_clips(2))
    expected, got = answer_of(model), answer_of(quantized(model, what, scales))
    step = float(scales["next_disparity"].step)
    assert np.abs(expected - expected.mean()).max() > 5 * step  # there is something to lose
    np.testing.assert_allclose(got, expected, atol=2 * step)


def test_convolutions_of_features_become_bytes_and_images_stay() -> None:
    model = wall_model()
    what = plan_quantization(model)
    assert what.convolutions == {"a", "b", "next_disparity"}
    scales = found_scales(model, what, wall_clips(1))
    graph = quantized(model, what, scales).graph
    weights = {tensor.name: tensor.data_type for tensor in graph.initializer}
    for result in what.convolutions:
        assert weights[f"{result}.weight.bytes"] == TensorProto.INT8
    assert weights["patch.weight"] == TensorProto.FLOAT
    # Relus of bytes are the range of the bytes; the image's is one more before the bytes begin.
    assert Counter(node.op_type for node in graph.node)["Relu"] == 1


def with_a_wider_view(model: ModelProto) -> ModelProto:
    """The same, but the answer also hears a little of features at half size, and of the image."""
    nodes = model.graph.node
    (place,) = (k for k, node in enumerate(nodes) if node.output[0] == "next_disparity")
    (whole,) = (tensor for tensor in model.graph.initializer if tensor.name == "answer.weight")
    random = np.random.default_rng(1)
    half = random.normal(0, 0.1, (16, 16, 3, 3)).astype(np.float32)
    more = random.normal(0, 0.002, (1, 24, 3, 3)).astype(np.float32)
    answer = np.concatenate((numpy_helper.to_array(whole), more), axis=1)
    model.graph.initializer.remove(whole)
    two = np.array([1, 1, 2, 2], np.float32)
    constants = {"half.weight": half, "answer.weight": answer, "two": two}
    model.graph.initializer.extend(
        numpy_helper.from_array(value, name) for name, value in constants.items()
    )
    how = {"nearest_mode": "floor", "coordinate_transformation_mode": "asymmetric"}
    wider = [
        helper.make_node(
            "Conv", ["both_positive", "half.weight"], ["half"], strides=[2, 2], pads=[1, 1, 1, 1]
        ),
        helper.make_node("Resize", ["half", "", "two"], ["twice"], mode="nearest", **how),
        helper.make_node("Concat", ["both_positive", "twice", "patches"], ["joined"], axis=1),
    ]
    nodes[place].input[0] = "joined"
    for node in reversed(wider):
        nodes.insert(place, node)
    onnx.checker.check_model(model)
    return model


def test_bytes_are_put_together_and_doubled_as_they_are() -> None:
    model = with_a_wider_view(wall_model())
    what = plan_quantization(model)
    scales = found_scales(model, what, wall_clips(2))
    int8 = quantized(model, what, scales)
    step = float(scales["next_disparity"].step)
    np.testing.assert_allclose(answer_of(int8), answer_of(model), atol=3 * step)
    made_by = {name: node for node in int8.graph.node for name in node.output}
    resized = {node.output[0] for node in int8.graph.node if node.op_type == "Resize"}
    assert resized == {"large"}  # four times the size is left as it was, twice is copies
    assert {made_by[name].op_type for name in made_by["joined"].input} == {"DequantizeLinear"}


def test_split_weights_become_constants_of_their_own() -> None:
    model = wall_model()
    (place,) = (k for k, node in enumerate(model.graph.node) if node.output[0] == "a")
    split = helper.make_node("Split", ["first.weight", "sizes"], ["head", "rest"], axis=0)
    joined = helper.make_node("Concat", ["head", "rest"], ["first"], axis=0)
    model.graph.node[place].input[1] = "first"
    for node in (joined, split):
        model.graph.node.insert(place, node)
    sizes = numpy_helper.from_array(np.array([5, 11], np.int64), "sizes")
    model.graph.initializer.append(sizes)
    apart = with_weights_apart(model)
    assert "Split" not in {node.op_type for node in apart.graph.node}
    np.testing.assert_array_equal(answer_of(apart), answer_of(model))


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (0.0, 6.0), (2.0, 5.0), (-3.0, -1.0)])
def test_a_scale_covers_its_range_and_zero_is_exact(low: float, high: float) -> None:
    scale = ByteScale.of_range(low, high)
    ends = [float(scale.step) * (byte - int(scale.zero)) for byte in (0, 255)]
    tolerance = float(scale.step)  # zero sits on a whole byte
    assert ends[0] <= min(low, 0.0) + tolerance
    assert ends[1] >= max(high, 0.0) - tolerance


def test_graphs_are_made_and_the_loss_is_reported(pool: ClipPool) -> None:
    wall = wall_model()
    before = wall.SerializeToString()
    steps: list[str] = []
    models, entry = make_int8(
        {StepKind(1): wall, StepKind(2): wall},
        STATES,
        pool,
        max_disparity_px=192,
        on_step=steps.append,
    )
    assert [step.partition(": the ")[2].split()[0] for step in steps] == [
        *("ranges", "rounding", "loss"),
        *("ranges", "rounding"),
    ]
    story = cast("dict[str, Any]", entry)
    assert story["convolutions"] == 3
    assert story["measured_clips"] == 2
    assert 0 < story["float_epe_px"] < 1
    assert 0 < story["epe_px"] < MAX_LOSS * story["float_epe_px"]
    assert set(models) == {StepKind(1), StepKind(2)}
    for model in models.values():
        operators = {node.op_type for node in model.graph.node}
        assert {"QuantizeLinear", "DequantizeLinear"} <= operators
    assert wall.SerializeToString() == before


def test_what_loses_too_much_is_refused(pool: ClipPool) -> None:
    with pytest.raises(QuantizationError, match="1 iterations: EPE"):
        make_int8({StepKind(1): wall_model(outlier=3000.0)}, STATES, pool, max_disparity_px=192)
