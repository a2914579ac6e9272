"""Laws of pair sums: no two products of int8 weights and bytes exceed 16 bits.

Kernels of CPUs without VNNI are emulated in integers, so the laws hold or fail on every machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from onnx import ModelProto, TensorProto, helper, numpy_helper

from vergence_models.evaluate import WEIGHTS
from vergence_models.onnx_export.pair_sums import MOST, in_safe_parts, largest_pair, overflowing
from vergence_models.onnx_export.quantization_plan import plan_quantization
from vergence_models.onnx_export.quantize import ByteScale, quantized
from vergence_models.onnx_export.rounding import PatchStatistics
from vergence_proto.model_io import MANIFEST_NAME

Array = NDArray[Any]
Reals = NDArray[np.float64]
INT16 = np.iinfo(np.int16)
CONVOLUTIONS = 35  # of bytes in a warm step of the shipped network


def added_in_pairs(data: Array, weights: Array) -> Array:
    """Sums over rows of bytes times weights, [O, K] each, as a kernel without VNNI adds them.

    Two neighbours are added in 16 bits, where a sum that does not fit saturates; the rest is exact.
    """
    products = data.astype(np.int64) * weights
    products = np.pad(products, ((0, 0), (0, products.shape[1] % 2)))
    pairs = products[:, 0::2] + products[:, 1::2]
    return np.asarray(np.clip(pairs, INT16.min, INT16.max).sum(axis=1))


def worst_bytes(weights: Array, seed: int) -> Iterator[Array]:
    """Bytes for each row of weights that make its sum as large or as small as it can be; others."""
    random = np.random.default_rng(seed)
    yield 255 * (weights > 0)
    yield 255 * (weights < 0)
    yield np.full(weights.shape, 255)
    yield 255 * random.integers(0, 2, weights.shape)
    yield random.integers(0, 256, weights.shape)


def packed_orders(weights: Array, seed: int) -> Iterator[Array]:
    """Orders in which a kernel may take the rows; the largest two of a row meet in one of them."""
    given = np.broadcast_to(np.arange(weights.shape[1]), weights.shape)
    rising = np.argsort(weights, axis=1)
    yield from (given, np.roll(given, 1, axis=1), rising, rising[:, ::-1])
    yield np.random.default_rng(seed).permuted(given, axis=1)


def saturates(weights: Array, seed: int = 0) -> bool:
    """True if some bytes and some order of int8 weights [O, K] lead to a wrong sum."""
    return any(
        not np.array_equal(
            added_in_pairs(
                np.take_along_axis(data, order, axis=1), np.take_along_axis(weights, order, axis=1)
            ),
            (weights * data).sum(axis=1),
        )
        for data in worst_bytes(weights, seed)
        for order in packed_orders(weights, seed)
    )


def as_int8(
    weight: NDArray[np.float32], inputs: PatchStatistics | None = None
) -> tuple[Array, Array, Array]:
    """The int8 weights [O, ...], steps and bias [O] that the exporter gives a convolution."""
    constant = numpy_helper.from_array(weight, "weight")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["data", "weight"], ["found"])],
        "one",
        [helper.make_tensor_value_info("data", TensorProto.FLOAT, None)],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, None)],
        [constant],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    what = plan_quantization(model)
    scales = {name: ByteScale.of_range(0, 1) for name in what.measured}
    made = quantized(model, what, scales, {} if inputs is None else {"found": inputs})
    assert overflowing(made) == []
    kept = {tensor.name: numpy_helper.to_array(tensor) for tensor in made.graph.initializer}
    bias = kept["found.bias.bytes"] * kept["found.bias.step"].astype(np.float64)
    return kept["found.weight.bytes"].astype(np.int64), kept["found.weight.step"], bias


# Ties and outliers: where a sum of two is at its limit, and where one weight stands alone.
ELEMENTS = st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e-6, -100.0]) | st.floats(-2, 2, width=32)
SHAPES = st.tuples(st.integers(1, 4), st.integers(4, 6), st.sampled_from([1, 3])).map(
    lambda shape: (*shape, shape[2])
)


@settings(deadline=None, max_examples=60)
@given(
    weight=SHAPES.flatmap(lambda shape: arrays(np.float32, shape, elements=ELEMENTS)),
    seed=st.integers(0, 2**32 - 1),
)
@example(weight=np.ones((1, 4, 1, 1), np.float32), seed=0)
@example(weight=np.array([129, 127, 1, -1], np.float32).reshape(1, 4, 1, 1), seed=0)
@example(weight=np.zeros((2, 4, 1, 1), np.float32), seed=0)
def test_int8_weights_give_exact_sums_in_any_order(weight: NDArray[np.float32], seed: int) -> None:
    values, step, _ = as_int8(weight)
    assert not saturates(values.reshape(len(values), -1), seed)
    # No weight is cut off, and the rule costs at most one bit of eight.
    wide = step[:, None, None, None].astype(np.float64)
    assert (np.abs(values * wide - weight) <= 0.5001 * wide).all()
    largest = np.abs(weight).max(axis=(1, 2, 3))
    assert (step <= np.maximum(2 * largest / 127, 1.1e-12)).all()


def inputs_like(seed: int, count: int) -> tuple[Reals, PatchStatistics]:
    """Samples [N, count] of inputs that vary together, and their statistics."""
    random = np.random.default_rng(seed)
    causes = random.uniform(0, 1, (500, 3))
    seen = causes @ random.uniform(0, 1, (3, count)) + 0.02 * random.normal(size=(500, count))
    return seen, PatchStatistics(seen.mean(axis=0), np.cov(seen.T, bias=True))


@settings(deadline=None, max_examples=60)
@given(
    weight=SHAPES.flatmap(lambda shape: arrays(np.float32, shape, elements=ELEMENTS)),
    seed=st.integers(0, 2**32 - 1),
)
@example(weight=np.array([200, 1, 1, 1, 1, -1], np.float32).reshape(1, 6, 1, 1), seed=0)
def test_weights_that_take_over_errors_are_exact_too(
    weight: NDArray[np.float32], seed: int
) -> None:
    _, inputs = inputs_like(seed, weight[0].size)
    values, _, _ = as_int8(weight, inputs)
    assert not saturates(values.reshape(len(values), -1), seed)


@pytest.mark.parametrize("seed", range(5))
def test_taking_over_errors_makes_sums_better(seed: int) -> None:
    weight = np.random.default_rng(seed).normal(size=(8, 16, 3, 3)).astype(np.float32)
    seen, inputs = inputs_like(seed, weight[0].size)
    expected = seen @ weight.reshape(8, -1).T

    def error(given: PatchStatistics | None) -> float:
        values, step, bias = as_int8(weight, given)
        found = seen @ (values.reshape(8, -1) * step[:, None].astype(np.float64)).T + bias
        return float(np.square(found - expected).mean())

    assert error(inputs) < 0.5 * error(None)


def test_the_emulation_saturates_where_the_rule_is_broken() -> None:
    full, data = np.array([[127, 127, 0, 0]]), np.full((1, 4), 255)
    assert added_in_pairs(data, full) == [INT16.max]
    assert added_in_pairs(data, full[:, [0, 2, 1, 3]]) == [2 * 255 * 127]
    assert saturates(np.array([[65, 1, 64, 0]]))
    assert not saturates(np.array([[64, 1, 64, -128]]))


@given(
    weight=arrays(
        np.int8,
        st.tuples(st.integers(1, 12), st.integers(1, 4)),
        elements=st.sampled_from([127, -127, 64, -64, 1, 0]) | st.integers(-127, 127),
    )
)
def test_whole_numbers_are_one_safe_matrix_or_two(weight: NDArray[np.int8]) -> None:
    parts = in_safe_parts(weight)
    assert np.array_equal(np.sum(parts, axis=0, dtype=np.int64), weight)
    assert not any(saturates(part.T.astype(np.int64)) for part in parts)
    assert len(parts) == 1 or saturates(weight.T.astype(np.int64))


def shipped_graphs() -> list[str]:
    manifest = json.loads((WEIGHTS / MANIFEST_NAME).read_text("utf-8"))
    return sorted(name for name in manifest["models"]["lite"]["files"] if name.endswith(".onnx"))


def int8_weights(model: ModelProto) -> dict[str, Array]:
    """Every int8 constant of a graph that a product may take: [O, K], by its name."""
    found = {}
    matrices = {
        node.input[1] for node in model.graph.node if node.op_type in ("MatMul", "MatMulInteger")
    }
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.INT8 and len(tensor.dims) > 1:
            values = numpy_helper.to_array(tensor).astype(np.int64)
            if len(tensor.dims) == 4:
                values = values.transpose(0, 2, 3, 1)  # as kernels with channels last pack them
            rows = values.T if tensor.name in matrices else values.reshape(len(values), -1)
            found[tensor.name] = rows
    return found


@pytest.mark.parametrize("name", shipped_graphs())
def test_every_product_of_a_shipped_graph_is_exact(name: str) -> None:
    model = onnx.load(WEIGHTS / name)
    assert overflowing(model) == []
    weights = int8_weights(model)
    assert weights
    assert [name for name, rows in weights.items() if saturates(rows)] == []


def test_the_check_goes_over_all_convolutions_of_bytes() -> None:
    step = [onnx.load(WEIGHTS / f"lite_{part}.onnx") for part in ("begin_0", "begin_1", "1")]
    named = [name for model in step for name in int8_weights(model)]
    assert len([name for name in named if name.endswith(".weight.bytes")]) == CONVOLUTIONS


def with_weights_up_to_127(model: ModelProto) -> ModelProto:
    """The same graph with the whole range of int8 for each channel of a convolution."""
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.INT8 and len(tensor.dims) == 4:
            values = numpy_helper.to_array(tensor).astype(np.float64)
            largest = np.maximum(np.abs(values).max(axis=(1, 2, 3), keepdims=True), 1)
            wide = np.rint(values * (127 / largest)).astype(np.int8)
            tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))
    return model


def test_the_check_finds_weights_that_use_all_of_int8() -> None:
    model = with_weights_up_to_127(onnx.load(WEIGHTS / "lite_begin_1.onnx"))
    found = overflowing(model)
    assert "begin_1.conv2d_3" in found
    assert len(found) > 5
    assert any(saturates(rows) for rows in int8_weights(model).values())


def product_model(second: Array) -> ModelProto:
    """Bytes [M, K] times a matrix [K, N] that is an input as well, both dequantised."""
    dequantized = [
        helper.make_node("DequantizeLinear", [name, "one", zero], [f"{name}.real"])
        for name, zero in (("a", "zero"), ("b", "b.zero"))
    ]
    coarse = 255 * 255 * len(second) / 200
    graph = helper.make_graph(
        [
            *dequantized,
            helper.make_node("MatMul", ["a.real", "b.real"], ["c.real"]),
            helper.make_node("QuantizeLinear", ["c.real", "coarse", "zero"], ["c"]),
        ],
        "product",
        [
            helper.make_tensor_value_info("a", TensorProto.UINT8, None),
            helper.make_tensor_value_info(
                "b", helper.np_dtype_to_tensor_dtype(second.dtype), second.shape
            ),
        ],
        [helper.make_tensor_value_info("c", TensorProto.UINT8, None)],
        [
            numpy_helper.from_array(np.array(1, np.float32), "one"),
            numpy_helper.from_array(np.array(0, np.uint8), "zero"),
            numpy_helper.from_array(np.array(0, second.dtype), "b.zero"),
            numpy_helper.from_array(np.array(coarse, np.float32), "coarse"),
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


@pytest.mark.parametrize("depth", [2, 16, 48])
def test_a_product_of_two_byte_activations_does_not_saturate(depth: int) -> None:
    a, b = np.full((7, depth), 255, np.uint8), np.full((depth, 33), 255, np.uint8)
    model = product_model(b)
    assert overflowing(model) == []
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    (found,) = session.run(None, {"a": a, "b": b})
    assert np.unique(found).tolist() == [200]


def test_an_int8_activation_is_reported() -> None:
    assert overflowing(product_model(np.ones((2, 2), np.int8))) == ["c.real"]


def test_largest_pair_is_of_one_sign_and_one_channel() -> None:
    weight = np.array([[64, -100, 65, -3], [1, 2, 3, 4], [127, 0, 0, -128]])
    assert largest_pair(weight).tolist() == [129, 7, 128]
    assert largest_pair(np.array([[-90]])).tolist() == [90]
    assert INT16.max >= MOST * 255
