"""Laws of bytes beside convolutions: sums of images are exact, and so is what only copies them."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from vergence_models.onnx_export.quantization_plan import plan_quantization
from vergence_models.onnx_export.quantize import ByteScale, quantized

Array = NDArray[Any]


def node(op: str, inputs: str, output: str, **attributes: Any) -> NodeProto:
    return helper.make_node(op, inputs.split(), [output], **attributes)


def model_of(
    nodes: list[NodeProto], constants: dict[str, Array], inputs: dict[str, int], output: str
) -> ModelProto:
    """``inputs``: the element type of each; shapes are left open."""
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, kind, None) for name, kind in inputs.items()],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def answer(model: ModelProto, feeds: dict[str, Array]) -> Array:
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    (result,) = session.run(None, feeds)
    return np.asarray(result)


def operators(model: ModelProto) -> set[str]:
    return {each.op_type for each in model.graph.node}


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), largest=st.sampled_from([1, 5, 127]))
def test_sums_of_an_image_are_whole_numbers(seed: int, largest: int) -> None:
    random = np.random.default_rng(seed)
    weight = random.integers(-largest, largest + 1, (12, 4)).astype(np.float32)
    weight[0, 0] = largest
    model = model_of(
        [
            node("Reshape", "image rows", "bytes"),
            node("Cast", "bytes", "real", to=TensorProto.FLOAT),
            node("MatMul", "real weight", "sums"),
        ],
        {"rows": np.array([-1, 12], np.int64), "weight": weight},
        {"image": TensorProto.UINT8},
        "sums",
    )
    what = plan_quantization(model)
    assert not what.measured
    image = random.integers(0, 256, (2, 3, 8, 3)).astype(np.uint8)
    made = quantized(model, what, {})
    assert "MatMulInteger" in operators(made)
    np.testing.assert_array_equal(answer(made, {"image": image}), answer(model, {"image": image}))


def test_a_product_with_fractions_stays_real() -> None:
    model = model_of(
        [
            node("Cast", "image", "real", to=TensorProto.FLOAT),
            node("MatMul", "real weight", "sums"),
        ],
        {"weight": np.full((12, 4), 0.5, np.float32)},
        {"image": TensorProto.UINT8},
        "sums",
    )
    assert "MatMulInteger" not in operators(quantized(model, plan_quantization(model), {}))


def scores_model(*, read: list[NodeProto]) -> ModelProto:
    """Products of two rows of features, read by some nodes that end in ``found``."""
    return model_of(
        [node("MatMul", "a b", "scores"), node("Reshape", "scores flat", "row"), *read],
        {"flat": np.array([0, -1], np.int64)},
        {"a": TensorProto.FLOAT, "b": TensorProto.FLOAT, "index": TensorProto.INT64},
        "found",
    )


def features(seed: int) -> dict[str, Array]:
    random = np.random.default_rng(seed)
    return {
        "a": random.uniform(-1, 1, (2, 5, 16)).astype(np.float32),
        "b": random.uniform(-1, 1, (2, 16, 6)).astype(np.float32),
        "index": random.integers(0, 30, (2, 9)),
    }


def test_scores_that_are_only_looked_up_become_bytes() -> None:
    gather = node("GatherElements", "row index", "some", axis=1)
    model = scores_model(read=[gather, node("Neg", "some", "found")])
    what = plan_quantization(model)
    assert what.products == {"scores"}
    assert what.measured == ["a", "b", "scores"]
    feeds = features(1)
    exact = np.matmul(feeds["a"], feeds["b"])
    step = ByteScale.of_range(float(exact.min()), float(exact.max()))
    scales = {"a": ByteScale.of_range(-1, 1), "b": ByteScale.of_range(-1, 1), "scores": step}
    made = quantized(model, what, scales)
    # Half a step of either factor, 16 times, and of the result.
    tolerance = 16 * float(scales["a"].step) + float(step.step)
    expected = answer(model, feeds)
    assert np.ptp(expected) > 4 * tolerance
    np.testing.assert_allclose(answer(made, feeds), expected, atol=tolerance)
    # What is read of the scores are bytes; nothing makes reals of all of them.
    (found,) = (each for each in made.graph.node if each.op_type == "GatherElements")
    assert found.input[0].endswith(".bytes")


def test_scores_that_something_else_reads_stay_real() -> None:
    model = scores_model(
        read=[
            node("GatherElements", "row index", "some", axis=1),
            node("ReduceMax", "row", "most", keepdims=1),
            node("Sub", "some most", "found"),
        ]
    )
    assert not plan_quantization(model).products
