"""What a manifest says, and how one that is wrong is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.weights_copy import WEIGHTS, Entry, copied_weights
from vergence_proto.model_io import MANIFEST_NAME, ManifestError, load_model_card


def test_a_card_names_the_graphs_of_each_stage() -> None:
    card = load_model_card(WEIGHTS, "staged")
    first = (WEIGHTS / "left.onnx", WEIGHTS / "right.onnx")
    assert card.graphs == {
        1: (first, (WEIGHTS / "staged_1.onnx",)),
        2: (first, (WEIGHTS / "staged_2.onnx",)),
    }
    assert card.input_names == ("left", "right", "uvd_curr_from_prev", "prev_memory")
    assert card.output_names == ("disparity", "sigma", "next_memory")


def test_the_identity_is_that_of_the_files_whatever_their_order(tmp_path: Path) -> None:
    def turn_around(entry: Entry) -> None:
        entry["files"] = dict(reversed(entry["files"].items()))

    turned = load_model_card(copied_weights(tmp_path, edit=turn_around), "staged")
    identity = load_model_card(WEIGHTS, "staged").weights_sha256
    assert turned.weights_sha256 == identity
    assert load_model_card(WEIGHTS, "whole").weights_sha256 != identity


@pytest.mark.parametrize("file", ["left.onnx", "staged_2.onnx"], ids=["shared", "of one count"])
def test_a_damaged_file_is_refused(tmp_path: Path, file: str) -> None:
    weights = copied_weights(tmp_path)
    content = bytearray((weights / file).read_bytes())
    content[len(content) // 2] ^= 1
    (weights / file).write_bytes(content)
    with pytest.raises(ManifestError, match=rf"{file}: expected sha256 .* got .* damaged"):
        load_model_card(weights, "staged")


def test_a_file_beside_the_graphs_counts_as_they_do(tmp_path: Path) -> None:
    def say_more(entry: Entry) -> None:
        entry["files"]["staged.weights"] = "0" * 64

    weights = copied_weights(tmp_path, edit=say_more)
    with pytest.raises(ManifestError, match=r"names .*staged\.weights, which does not exist"):
        load_model_card(weights, "staged")
    (weights / "staged.weights").write_bytes(b"of another export")
    with pytest.raises(ManifestError, match=r"staged\.weights: expected sha256 0000"):
        load_model_card(weights, "staged")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    weights = copied_weights(tmp_path)
    (weights / "right.onnx").unlink()
    with pytest.raises(ManifestError, match=r"names .*right\.onnx, which does not exist"):
        load_model_card(weights, "staged")


def test_a_first_step_has_graphs_of_its_own_where_there_are_any(tmp_path: Path) -> None:
    def start_otherwise(entry: Entry) -> None:
        entry["cold_graphs"] = {"1": [["left.onnx", "right.onnx"], ["staged_2.onnx"]]}
        entry["cold_max_pixels"] = 1000

    weights = copied_weights(tmp_path, edit=start_otherwise)
    card = load_model_card(weights, "staged")
    cold, warm = card.stages(1, cold_pixels=1000), card.stages(1)
    assert cold[-1] == (weights / "staged_2.onnx",)
    assert warm[-1] == (weights / "staged_1.onnx",)
    assert card.stages(2, cold_pixels=1000) == card.stages(2)
    assert card.stages(1, cold_pixels=1001) == warm


def leave_out(entry: Entry) -> None:
    del entry["files"]["right.onnx"]


def rename(entry: Entry) -> None:
    entry["graphs"]["2"][0][1] = "right_2.onnx"


def start_with_another(entry: Entry) -> None:
    entry["cold_graphs"] = {"2": [["staged_9.onnx"]]}


@pytest.mark.parametrize(
    ("edit", "file"),
    [(leave_out, "right.onnx"), (rename, "right_2.onnx"), (start_with_another, "staged_9.onnx")],
)
def test_a_graph_without_a_digest_is_refused(
    tmp_path: Path, edit: Callable[[Entry], None], file: str
) -> None:
    weights = copied_weights(tmp_path, edit=edit)
    says = f"model 'staged' runs {file}, which is not among its files"
    with pytest.raises(ManifestError, match=says):
        load_model_card(weights, "staged")


def test_another_format_is_refused(tmp_path: Path) -> None:
    weights = copied_weights(tmp_path)
    (weights / MANIFEST_NAME).write_text(json.dumps({"format": 1, "models": {}}), "utf-8")
    with pytest.raises(ManifestError, match="expected manifest format 2, got 1"):
        load_model_card(weights, "staged")
