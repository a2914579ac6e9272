"""Laws of stages: cut apart, a step is what it was whole."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from vergence_models.config import StepKind
from vergence_models.onnx_export.stages import StageError, handed_on, in_stages
from vergence_models.onnx_export.stitch import RefinementAt2x, StepParts, stitched

Array = NDArray[Any]
KINDS = (StepKind(1), StepKind(3), StepKind(3, at_2x=1))


def part(
    nodes: list[NodeProto], inputs: list[str], outputs: list[str], weight: float
) -> ModelProto:
    def described(names: list[str]) -> list[Any]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N"]) for name in names]

    constants = [numpy_helper.from_array(np.array([weight], np.float32), "weight")]
    graph = helper.make_graph(nodes, "part", described(inputs), described(outputs), constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def node(op: str, inputs: str, output: str) -> NodeProto:
    return helper.make_node(op, inputs.split(), [output], name=output)


def parts() -> StepParts[ModelProto]:
    """state = state * 0.5 + left * 3 + right / 7, over and over; then twice that."""
    return StepParts(
        begin=(
            part(
                [node("Mul", "left weight", "near"), node("Neg", "state", "at_state")],
                ["left", "right", "state"],
                ["near", "at_state"],
                3.0,
            ),
            part([node("Div", "right weight", "far")], ["right"], ["far"], 7.0),
        ),
        iterate=part(
            [
                node("Mul", "at_state weight", "half"),
                node("Add", "half near", "more"),
                node("Add", "more far", "to_at_state"),
            ],
            ["near", "far", "at_state"],
            ["to_at_state"],
            0.5,
        ),
        end=part([node("Mul", "at_state weight", "answer")], ["at_state"], ["answer"], 2.0),
        at_2x=RefinementAt2x(
            enter=part(
                [
                    node("Add", "left weight", "to_left"),
                    node("Sub", "right weight", "to_right"),
                    node("Mul", "answer weight", "to_state"),
                ],
                ["left", "right", "answer"],
                ["to_left", "to_right", "to_state"],
                11.0,
            ),
            moved={"state": "at_state"},
            join=part(
                [
                    node("Sub", "plain_answer answer", "less"),
                    node("Div", "less weight", "to_answer"),
                ],
                ["plain_answer", "answer"],
                ["to_answer"],
                13.0,
            ),
        ),
    )


def computed(kind: StepKind, left: Array, right: Array, state: Array) -> Array:
    """The result of :func:`parts`, in numpy."""

    def iterated(left: Array, right: Array, state: Array, count: int) -> Array:
        for _ in range(count):
            state = state * np.float32(0.5) + left * np.float32(3) + right / np.float32(7)
        return state

    plain = 2 * iterated(left, right, -state, kind.iterations - kind.at_2x)
    if not kind.at_2x:
        return plain
    again = 2 * iterated(left + 11, right - 11, plain * 11, kind.at_2x)
    joined: Array = (plain - again) / np.float32(13)
    return joined


def run(model: ModelProto, tensors: dict[str, Array]) -> dict[str, Array]:
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    feeds = {entry.name: tensors[entry.name] for entry in session.get_inputs()}
    names = [entry.name for entry in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))


def test_stages_one_after_another_are_the_whole_step() -> None:
    models = {kind: stitched(parts(), kind) for kind in KINDS}
    stages, files = in_stages("tiny", models, handed_on(parts()))
    assert stages == {
        kind: [["tiny_begin_0.onnx", "tiny_begin_1.onnx"], [f"tiny_{kind}.onnx"]] for kind in KINDS
    }
    random = np.random.default_rng(0)
    given = {name: random.normal(size=4).astype(np.float32) for name in ("left", "right", "state")}
    for kind in KINDS:
        known = dict(given)
        for stage in stages[kind]:
            known |= {
                name: value for file in stage for name, value in run(files[file], known).items()
            }
        np.testing.assert_array_equal(known["answer"], run(models[kind], given)["answer"])
        expected = computed(kind, given["left"], given["right"], given["state"])
        np.testing.assert_allclose(known["answer"], expected, rtol=1e-4, atol=1e-4)


def test_a_graph_holds_only_its_own() -> None:
    models = {kind: stitched(parts(), kind) for kind in KINDS}
    _, files = in_stages("tiny", models, handed_on(parts()))
    kept = {
        name: {tensor.name for tensor in model.graph.initializer} for name, model in files.items()
    }
    assert kept["tiny_begin_0.onnx"] == {"begin_0.weight"}
    assert kept["tiny_begin_1.onnx"] == {"begin_1.weight"}
    assert kept["tiny_3.onnx"] == {"iterate.weight", "end.weight"}
    # 2x refinement runs the first part again, but does not warp its state.
    at_2x = {f"closer_begin_{number}.{name}" for number, name in enumerate(("near", "far"))}
    made = {name for each in files["tiny_3_cold.onnx"].graph.node for name in each.output}
    assert at_2x < made
    assert "closer_begin_0.at_state" not in made
    assert [entry.name for entry in files["tiny_begin_1.onnx"].graph.input] == ["right"]


def test_a_beginning_that_depends_on_the_count_is_refused() -> None:
    models = {kind: stitched(parts(), kind) for kind in KINDS}
    (weight,) = (
        each for each in models[StepKind(3)].graph.initializer if each.name == "begin_1.weight"
    )
    weight.CopyFrom(numpy_helper.from_array(np.array([8.0], np.float32), "begin_1.weight"))
    with pytest.raises(StageError, match=r"tiny_begin_1\.onnx: tiny_3 needs another graph than"):
        in_stages("tiny", models, handed_on(parts()))
