"""Graphs in every published layout: added, proven, served; and refused with the word for it."""

import functools
import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx.external_data_helper import set_external_data
from typer.testing import CliRunner

from tests.support.foreign_graphs import (
    BYTES,
    DISPARITIES,
    GRAPHS,
    HEIGHT,
    UNIT,
    WIDTH,
    joined,
    two_images,
    written,
)
from vergence_models.evaluate import evaluate, methods_for
from vergence_models.evaluation.classical import classical_methods
from vergence_models.evaluation.stepping import Footage, FootageView
from vergence_models.foreign.adding import Added, add_model, check_model
from vergence_models.foreign.command import models
from vergence_models.foreign.compose import UNSEEN_PX
from vergence_models.foreign.contract import Contract, ContractError
from vergence_models.foreign.files import read_manifest, write_model
from vergence_models.foreign.guess import Given, iterations_in
from vergence_models.foreign.published import PUBLISHED
from vergence_models.foreign.textures import Scene, scene
from vergence_models.studies.networks import gather_networks
from vergence_proto.geometry import RectifiedRig
from vergence_proto.model_io import (
    MANIFEST_NAME,
    ManifestError,
    load_model_card,
    user_models_dir,
)
from vergence_service.app.server import make_model
from vergence_service.inference.model import Step, StepResult, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel
from vergence_service.settings import load_settings

RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def add_layout(folder: Path) -> Callable[[str], Added]:
    """Add the graph of a layout under its name, once."""

    @functools.cache
    def add_once(name: str) -> Added:
        path = written(GRAPHS[name].make(), folder / f"{key_of(name)}.of-others")
        return add(folder, path, key_of(name), max_disparity_px=DISPARITIES)

    return add_once


def key_of(name: str) -> str:
    return name.replace(" ", "-").replace(",", "")


def add(folder: Path, path: Path, name: str = "net", **given: Any) -> Added:
    return add_model({1: path}, folder, name=name, given=Given(**given))


def served(folder: Path, name: str, pair: Scene) -> StepResult:
    model = OnnxStereoModel(folder, name, providers=["cpu"], threads=1, allow_spinning=False)
    [result] = model.step([Step(StereoView(pair.left, pair.right, RIG, 1), None, 1)])
    return result


def share_right(found_px: np.ndarray[Any, Any], pair: Scene) -> float:
    known = np.isfinite(pair.truth_px)
    return float((np.abs(found_px - pair.truth_px)[known] <= 1).mean())


@pytest.mark.parametrize("name", GRAPHS)
def test_a_published_layout_is_guessed_proven_and_served(
    name: str, folder: Path, add_layout: Callable[[str], Added]
) -> None:
    layout = GRAPHS[name]
    added = add_layout(name)
    contract = added.contract
    assert (contract.pixels, contract.factor) == (layout.pixels, layout.factor)
    assert added.like == layout.like
    # What the server computes is what the foreign graph returns, in pixels.
    pair = scene(HEIGHT, WIDTH, 6, 30, seed=1)
    result = served(folder, key_of(name), pair)
    assert result.offset_px.dtype == np.float32
    np.testing.assert_array_equal(result.offset_px, np.rint(result.offset_px))
    assert share_right(result.offset_px, pair) > 0.95
    assert (result.sigma_px > 0).all()


def test_the_served_map_is_bit_for_bit_what_the_graph_returns(
    folder: Path, add_layout: Callable[[str], Added]
) -> None:
    add_layout("raft")
    pair = scene(HEIGHT, WIDTH, 3, 20, seed=2)
    path = folder / "raft.of-others"
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    views = (each.transpose(2, 0, 1)[None].astype(np.float32) for each in (pair.left, pair.right))
    [flow] = session.run(None, dict(zip(("x1", "x2"), views, strict=True)))
    np.testing.assert_array_equal(served(folder, "raft", pair).offset_px, -flow[0, 0])


def test_images_of_another_size_than_the_graph_are_resized_and_so_is_disparity(
    folder: Path, add_layout: Callable[[str], Added]
) -> None:
    add_layout("raft")
    pair = scene(2 * HEIGHT, 2 * WIDTH, 12, 12, seed=3)
    large = served(folder, "raft", pair).offset_px
    assert large.shape == (2 * HEIGHT, 2 * WIDTH)
    assert np.median(large[:, 40:]) == 12
    narrow = scene(2 * HEIGHT, WIDTH, 12, 12, seed=3)  # another aspect: only the width counts
    assert np.median(served(folder, "raft", narrow).offset_px[:, 40:]) == 12


# What is wrong with a contract, and the words for it.
WRONG: dict[str, tuple[str, Callable[[Contract], Contract], str]] = {
    "sign": ("raft", lambda c: replace(c, factor=1.0), r"sign: the output is -4 for 4 px"),
    "sign of a positive one": ("igev", lambda c: replace(c, factor=-1.0), "sign: the output is 4"),
    "scale": ("igev", lambda c: replace(c, factor=16.0), r"scale: .* factor is 1, not 16"),
    "sides": ("igev", lambda c: replace(c, swapped=True), "sides: "),
    "sides of a flow": ("raft", lambda c: replace(c, left="x2", right="x1"), "sides: "),
    "pixels": ("acvnet", lambda c: replace(c, pixels="0..255"), "normalisation: .* imagenet,"),
    "pixels of bytes": ("raft", lambda c: replace(c, pixels="0..1"), r"normalisation: .*0\.\.255"),
    "signed pixels": ("hitnet", lambda c: replace(c, pixels="-1..1"), r"normalisation: .*0\.\.1,"),
    "range": ("igev", lambda c: replace(c, max_disparity_px=96), "range: .* up to 48 px are found"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_contract_is_refused_with_what_was_seen(
    kind: str, folder: Path, tmp_path: Path, add_layout: Callable[[str], Added]
) -> None:
    layout, spoil, says = WRONG[kind]
    right = add_layout(layout)
    network = folder / f"{layout}.1.onnx"
    write_model(tmp_path, "wrong", spoil(right.contract), {1: network}, proven=True)
    with pytest.raises(ContractError, match=says):
        check_model(tmp_path, "wrong")


def test_a_model_that_was_added_passes_its_check(
    folder: Path, add_layout: Callable[[str], Added]
) -> None:
    for name in ("raft", "ess", "crestereo"):
        assert check_model(folder, name).contract == add_layout(name).contract


def test_what_the_user_says_is_not_corrected_and_nothing_is_written(tmp_path: Path) -> None:
    path = written(GRAPHS["raft"].make(), tmp_path / "raft.onnx")
    for given, says in (
        ({"factor": 1.0}, "sign"),
        ({"left": "x2", "right": "x1"}, "sides"),
        ({"like": "acvnet"}, "normalisation"),
        ({"max_disparity_px": 128}, "range"),
        ({"output": "elsewhere"}, "no map called 'elsewhere', but output"),
        ({"sigma": "confidence"}, "no confidence"),
        ({"warm_start": True}, "no input for an initial flow"),
        ({"name": "lite"}, "lite is a model of this project"),
        ({"name": "a/b"}, "expected a name of small letters"),
        ({"like": "rafting"}, "there is no contract 'rafting'; there are raft-stereo"),
    ):
        with pytest.raises(ContractError, match=says):
            add(tmp_path / "to", path, **given)
    assert not (tmp_path / "to").exists()


def test_graphs_beside_the_contract_that_do_something_else_are_found(tmp_path: Path) -> None:
    path = written(GRAPHS["igev"].make(), tmp_path / "igev.onnx")
    add(tmp_path, path, "kept")
    add(tmp_path, path, "other", sigma_px=2.0)
    manifest = read_manifest(tmp_path)
    manifest["models"]["kept"]["foreign"]["contract"]["pixels"] = "0..1"
    (tmp_path / MANIFEST_NAME).write_text(json.dumps(manifest))
    with pytest.raises(ContractError, match="does not do what the contract in the manifest says"):
        check_model(tmp_path, "kept")


def test_sigma_is_the_networks_confidence_a_second_look_or_a_constant(
    folder: Path, tmp_path: Path
) -> None:
    pair = scene(HEIGHT, WIDTH, 6, 30, seed=4)
    ess = written(GRAPHS["ess"].make(), tmp_path / "ess.onnx")
    columns = np.arange(WIDTH)
    hidden = np.isnan(pair.truth_px) & (columns >= 6)  # behind the board, for the right camera
    for name, given in (
        ("said", {}),
        ("constant", {"sigma": "constant", "sigma_px": 0.5}),
        ("twice", {"sigma": "left-right", "sigma_px": 0.5}),
    ):
        add(folder, ess, name, **given)
        result = served(folder, name, pair)
        sigma = result.sigma_px
        outside = columns - result.offset_px < -0.5
        assert outside.any()
        assert (sigma[outside] == np.float32(UNSEEN_PX)).all()
        inside = ~outside & ~hidden
        usual = float(np.median(sigma[inside]))
        assert usual == pytest.approx(0.5 if given else -1 / np.log(0.2), rel=1e-3)
        found_out = np.mean(sigma[hidden] > 2)
        assert found_out > 0.6 if name == "twice" else found_out < 0.4


def test_weights_that_were_not_trained_are_refused_or_said_to_be_unproven(tmp_path: Path) -> None:
    graph = two_images("left", "right", "out", UNIT, factor=1)
    last = next(node for node in graph.graph.node if node.op_type == "ArgMin")
    last.op_type = "ArgMax"
    path = written(graph, tmp_path / "random.onnx")
    with pytest.raises(ContractError, match=r"no match: .* weights that were not trained"):
        add(tmp_path / "to", path)
    added = add_model({1: path}, tmp_path / "to", name="r", given=Given(), unproven=True)
    assert added.proof is None
    assert read_manifest(tmp_path / "to")["models"]["r"]["foreign"]["proven"] is False


def test_a_graph_that_looks_at_one_image_only_is_found_out(tmp_path: Path) -> None:
    graph = two_images("left", "right", "out", BYTES)
    for node in graph.graph.node:
        for index, name in enumerate(node.input):
            if name == "right":
                node.input[index] = "left"
    with pytest.raises(ContractError, match="one image: the right image changes nothing"):
        add(tmp_path / "to", written(graph, tmp_path / "a.onnx"))


def three_images() -> onnx.ModelProto:
    graph = two_images("left", "right", "out", BYTES)
    shape = [1, 3, HEIGHT, WIDTH]
    extra = onnx.helper.make_tensor_value_info("guide", onnx.TensorProto.FLOAT, shape)
    graph.graph.input.append(extra)
    return graph


def without_shape() -> onnx.ModelProto:
    graph = two_images("left", "right", "out", BYTES)
    graph.graph.input[0].type.tensor_type.ClearField("shape")
    return graph


def of_opset(version: int) -> onnx.ModelProto:
    graph = two_images("left", "right", "out", BYTES)
    graph.opset_import[0].version = version
    return graph


def with_a_plugin() -> onnx.ModelProto:
    graph = two_images("left", "right", "out", BYTES)
    graph.graph.node[0].op_type, graph.graph.node[0].domain = "CostVolume", "trt.plugins"
    graph.opset_import.append(onnx.helper.make_opsetid("trt.plugins", 1))
    return graph


BAD_GRAPHS: dict[str, tuple[Callable[[], onnx.ModelProto], str]] = {
    "three images": (three_images, r"expected one input with both .* guide \[1, 3, 96, 256\]"),
    "no rank": (without_shape, "left has no fixed number of dimensions"),
    "an opset of the future": (lambda: of_opset(99), "is of opset 99, and the newest here is"),
    "an opset of the past": (lambda: of_opset(6), "onnxruntime cannot load .*This is an invalid"),
    "a plugin": (with_a_plugin, "onnxruntime cannot load .*(CostVolume|trt.plugins)"),
    "five channels": (lambda: spoiled_channels(5), "expected one input with both|only input"),
}


def spoiled_channels(count: int) -> onnx.ModelProto:
    graph = joined(6)
    graph.graph.input[0].type.tensor_type.shape.dim[1].dim_value = count
    return graph


@pytest.mark.parametrize("kind", BAD_GRAPHS)
def test_a_graph_that_cannot_be_served_is_refused_in_one_sentence(
    kind: str, tmp_path: Path
) -> None:
    make, says = BAD_GRAPHS[kind]
    path = tmp_path / "bad.onnx"
    path.write_bytes(make().SerializeToString())
    with pytest.raises(ContractError, match=says) as refused:
        add(tmp_path / "to", path)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "to").exists()


def test_a_file_that_is_no_graph_is_refused_in_one_sentence(tmp_path: Path) -> None:
    pickled, empty, sparse, weights_gone, outside, large_beside, cut = (
        tmp_path / f"{i}.onnx" for i in range(7)
    )
    pickled.write_bytes(pickle.dumps({"state_dict": [1, 2, 3]}))
    empty.write_bytes(b"")
    with sparse.open("wb") as file:
        file.truncate(3 << 30)
    graph = two_images("left", "right", "out", BYTES)
    onnx.save(graph, weights_gone, save_as_external_data=True, location="w.bin", size_threshold=8)
    beside = add(tmp_path / "to", weights_gone)  # weights beside the graph are taken in
    assert beside.contract.factor == 1
    (tmp_path / "w.bin").unlink()
    cut.write_bytes(graph.SerializeToString()[:1000])
    for path, place in ((outside, "../w.bin"), (large_beside, sparse.name)):
        graph = two_images("left", "right", "out", BYTES)
        set_external_data(graph.graph.initializer[0], place)
        path.write_bytes(graph.SerializeToString())
    (tmp_path.parent / "w.bin").write_bytes(b"1234")
    for path, says in (
        (pickled, "is no ONNX file but a checkpoint of PyTorch"),
        (cut, "is no ONNX file"),
        (outside, "points outside the directory"),
        (large_beside, r"^5\.onnx has more than 2 GB of weights"),
        (empty, "is no ONNX file"),
        (sparse, "more than 2 GB of weights"),
        (weights_gone, r"lie beside it in w\.bin, which cannot be read"),
        (tmp_path / "none.onnx", "cannot read .*none.onnx: No such file"),
    ):
        with pytest.raises(ContractError, match=says) as refused:
            add(tmp_path / "to", path)
        assert "\n" not in str(refused.value)


def test_the_command_adds_lists_checks_and_the_server_finds_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "200")
    path = written(GRAPHS["igev"].make(), tmp_path / "igev_sceneflow.onnx")
    run = CliRunner()
    added = run.invoke(models, ["add", str(path), "--name", "theirs", "--max-disparity", "48"])
    assert added.exit_code == 0, added.output
    assert "vergence serve --model theirs" in added.output
    assert "like igev" in added.output
    listed = run.invoke(models, ["list"])
    for name in ("theirs", "lite", "sgbm", "patchmatch"):
        assert name in listed.output
    assert "sgbm" not in run.invoke(models, ["list", "--weights", str(user_models_dir())]).output
    checked = run.invoke(models, ["check", "theirs"])
    assert "proven on textures" in checked.output
    refused = run.invoke(models, ["add", str(path), "--factor", "-1"])
    assert refused.exit_code == 1
    assert refused.output.startswith("vergence models: sign:")
    assert len(refused.output.splitlines()) == 1
    model = make_model(load_settings(flags={"model.name": "theirs"}))
    assert model.card.max_disparity_px == DISPARITIES
    volume = 4 * DISPARITIES * HEIGHT * WIDTH  # bytes of the costs of every disparity
    assert volume < model.step_bytes(HEIGHT, WIDTH, 1, cold=True) < 60 * volume
    assert not model.card.recurrent
    assert load_model_card(tmp_path / "vergence" / "models", "theirs") == model.card
    contracts = run.invoke(models, ["contracts"])
    assert all(name in contracts.output for name in PUBLISHED)


def test_a_model_that_was_added_is_a_row_beside_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    path = written(GRAPHS["igev"].make(), tmp_path / "igev.onnx")
    add(user_models_dir(), path, "theirs", max_disparity_px=DISPARITIES)
    [studied] = gather_networks([], [], threads=1, models=["theirs"])
    assert (studied.warm, studied.single_frame, studied.warps) == ((), (1,), False)
    assert "trained by its authors" in studied.training.words
    with pytest.raises(ManifestError, match="has no model 'other'; it has theirs"):
        gather_networks([], [], threads=1, models=["other"])
    pair = scene(HEIGHT, WIDTH, 6, 30, seed=5)
    footage = Footage("pair", RIG, [FootageView(pair.left, pair.right, None, pair.truth_px)])
    methods = methods_for(studied.network, thorough=True) + classical_methods()
    found = evaluate(methods, iter([("pair", footage)]))["pair"]
    assert list(found) == [
        "theirs, every frame cold, 1 iteration",
        "SGBM, full size",
        "SGBM, half size",
        "PatchMatch, warm, 1 iteration",
    ]
    assert found["theirs, every frame cold, 1 iteration"].summary()["epe"] < 0.5


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("crestereo_combined_iter10_480x640", 10),
        ("raft_32iters", 32),
        ("igev", 1),
        ("x_iters_2", 2),
    ],
)
def test_the_iterations_of_published_files_are_in_their_names(name: str, count: int) -> None:
    assert iterations_in(name) == count
