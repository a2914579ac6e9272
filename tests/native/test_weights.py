"""Weights that the native step reads from ONNX files, and files that it must refuse."""

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import numpy_helper

from tests.native.conftest import STILL, assert_same_bits, graphs, nothing, random_pair, two_frames
from tests.support.weights_copy import WEIGHTS
from vergence_native import LiteStep, UnsupportedWeights
from vergence_native.onnx_graph import Graph
from vergence_proto.model_io import load_model_card
from vergence_service.inference.onnx_model import packaged_weights_dir


@pytest.mark.parametrize(
    "iterations", sorted(load_model_card(packaged_weights_dir(), "lite").graphs)
)
def test_the_reader_finds_what_onnx_finds(iterations: int) -> None:
    for path in graphs(iterations):
        graph = Graph()
        graph.add_file(path)
        model = onnx.load(path)
        assert [node.op_type for node in graph.nodes] == [n.op_type for n in model.graph.node]
        assert [node.inputs for node in graph.nodes] == [tuple(n.input) for n in model.graph.node]
        for node, theirs in zip(graph.nodes, model.graph.node, strict=True):
            for each in theirs.attribute:
                value = onnx.helper.get_attribute_value(each)
                expected = tuple(value) if isinstance(value, list) else value
                assert node.attributes[each.name] == expected
        for tensor in model.graph.initializer:
            assert (graph.constants[tensor.name] == numpy_helper.to_array(tensor)).all()


@pytest.mark.parametrize(
    "iterations", sorted(load_model_card(packaged_weights_dir(), "lite").graphs)
)
def test_every_step_of_the_shipped_model_is_supported(iterations: int) -> None:
    LiteStep(graphs(iterations), iterations=iterations).close()


def test_another_network_is_refused() -> None:
    card = load_model_card(WEIGHTS, "reciprocal")
    files = [path for stage in card.stages(min(card.graphs)) for path in stage]
    with pytest.raises(UnsupportedWeights):
        LiteStep(files, iterations=1)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedWeights, match="cannot read"):
        LiteStep([tmp_path / "none.onnx"], iterations=1)


def test_a_step_of_more_iterations_than_the_files_have_is_refused() -> None:
    with pytest.raises(UnsupportedWeights):
        LiteStep(graphs(1), iterations=2)


def changed(
    folder: Path, ending: str, values: np.ndarray | None, node: str | None = None
) -> list[Path]:
    """The files of a step, where the first constant whose name ends so has other values."""
    files = [Path(shutil.copy(path, folder)) for path in graphs(1)]
    model = onnx.load(files[-1])
    for tensor in model.graph.initializer:
        if tensor.name.endswith(ending):
            before = numpy_helper.to_array(tensor)
            made = (
                np.full_like(before, 1) if values is None else np.broadcast_to(values, before.shape)
            )
            tensor.CopyFrom(numpy_helper.from_array(made.astype(before.dtype), tensor.name))
            break
    onnx.save(model, files[-1])
    return files


@pytest.mark.parametrize(
    ("ending", "value"),
    [
        ("conv2d_17.weight.bytes", 127),  # two products do not fit into 16 bits
        ("conv2d_17.weight.bytes", -128),
        ("conv2d_17.bias.bytes", -(1 << 31)),
        ("conv2d_17.weight.step", np.nan),
        ("conv2d_17.weight.step", 0.0),
        ("conv2d_17.weight.step", np.inf),
        ("relu_1.step", -1.0),
        ("relu_1.step", 1e-40),
        ("subpixel", np.nan),
        ("subpixel", 1e30),
    ],
)
def test_values_that_sums_could_not_hold_are_refused(
    tmp_path: Path, ending: str, value: float
) -> None:
    with pytest.raises(UnsupportedWeights):
        LiteStep(changed(tmp_path, ending, np.array(value)), iterations=1)


def test_a_weight_of_another_shape_is_refused(tmp_path: Path) -> None:
    files = changed(tmp_path, "conv2d_17.weight.bytes", None)
    model = onnx.load(files[-1])
    for tensor in model.graph.initializer:
        if tensor.name.endswith("conv2d_17.weight.bytes"):
            array = numpy_helper.to_array(tensor)
            tensor.CopyFrom(numpy_helper.from_array(array[:, :16].copy(), tensor.name))
    onnx.save(model, files[-1])
    with pytest.raises(UnsupportedWeights):
        LiteStep(files, iterations=1)


def test_other_weights_of_the_same_network_are_taken(tmp_path: Path) -> None:
    """Retraining changes numbers alone; the numbers must come from the files."""
    trained = LiteStep(graphs(1), iterations=1)
    same = LiteStep(changed(tmp_path, "nothing has this ending", None), iterations=1)
    other = LiteStep(changed(tmp_path, "subpixel", np.array(3.0)), iterations=1)
    expected = two_frames(trained, 64, 192)
    assert_same_bits(two_frames(same, 64, 192), expected)
    assert (two_frames(other, 64, 192)[0].disparity != expected[0].disparity).any()
    for step in (trained, same, other):
        step.close()


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    files = [Path(shutil.copy(path, tmp_path)) for path in graphs(1)]
    path = files[data.draw(st.integers(0, len(files) - 1))]
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        step = LiteStep(files, iterations=1)
    except UnsupportedWeights:
        return
    step.step(*random_pair(32, 192), STILL, *nothing(32, 192))
    step.close()


@given(content=st.binary(max_size=200))
def test_any_bytes_are_a_graph_or_refused(content: bytes) -> None:
    graph = Graph()
    try:
        graph.add_bytes(content)
    except UnsupportedWeights:
        return
    with pytest.raises(UnsupportedWeights):
        graph.add_bytes(b"\xff" * 12)
