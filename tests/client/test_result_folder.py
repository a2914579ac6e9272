"""The files of a run hold its results, and nothing of an earlier run."""

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from vergence.cli.errors import CliError
from vergence.cli.result_folder import ResultFolder, make_room
from vergence_proto.datasets import read_disparity_png, read_pfm
from vergence_proto.geometry import RectifiedRig
from vergence_proto.jobs import Output, ResultFormat
from vergence_proto.types import DisparityMap

RIG = RectifiedRig(12, 9, 400, 400, 5.5, 3.5, 4, 0.1)
ALL = tuple(Output)


def a_result() -> DisparityMap:
    rng = np.random.default_rng(1)
    disparity_px = rng.uniform(1, 60, (9, 12)).astype(np.float32)
    disparity_px[0, :3] = np.nan
    return DisparityMap(
        1,
        0,
        RIG,
        disparity_px,
        sigma_px=rng.uniform(0.1, 400, (9, 12)).astype(np.float32),
        confidence=rng.integers(0, 256, (9, 12)).astype(np.uint8),
    )


def written(folder: Path, form: ResultFormat, *, alone: bool = False) -> list[str]:
    make_room(folder)
    files = ResultFolder(folder, outputs=ALL, form=form, alone=alone)
    files.begin(RIG)
    files.write(3, a_result())
    names = [str(each.relative_to(folder)) for each in folder.rglob("*") if each.is_file()]
    return sorted(names)


@pytest.mark.parametrize("form", [ResultFormat.PNG16, ResultFormat.PFM])
def test_every_map_has_a_file_that_other_programs_read(form: ResultFormat, tmp_path: Path) -> None:
    suffix = "png" if form is ResultFormat.PNG16 else "pfm"
    read = read_disparity_png if form is ResultFormat.PNG16 else read_pfm
    assert written(tmp_path, form) == [
        f"0003.{suffix}",
        "confidence/0003.png",
        f"depth/0003.{suffix}",
        "rig.json",
        f"sigma/0003.{suffix}",
    ]
    result = a_result()
    step = 1 / 512 if form is ResultFormat.PNG16 else 0
    sigma_px = result.sigma_px
    assert sigma_px is not None
    if form is ResultFormat.PNG16:
        sigma_px = np.minimum(sigma_px, 65535 / 256)
    for name, values in (("", result.offset_px), ("depth/", result.depth_m), ("sigma/", sigma_px)):
        found = read(tmp_path / f"{name}0003.{suffix}")
        np.testing.assert_allclose(found, values, rtol=0, atol=step + 1e-5)
    confidence = cv2.imread(str(tmp_path / "confidence/0003.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(confidence, result.confidence)
    assert json.loads((tmp_path / "rig.json").read_text()) == asdict(RIG)


def test_one_archive_holds_every_map_as_it_is(tmp_path: Path) -> None:
    assert written(tmp_path, ResultFormat.NPZ) == ["0003.npz", "rig.json"]
    with np.load(tmp_path / "0003.npz") as arrays:
        np.testing.assert_array_equal(arrays["disparity"], a_result().offset_px)
        np.testing.assert_array_equal(arrays["depth"], a_result().depth_m)
        np.testing.assert_array_equal(arrays["sigma"], a_result().sigma_px)
        np.testing.assert_array_equal(arrays["confidence"], a_result().confidence)


def test_a_pair_has_no_numbers(tmp_path: Path) -> None:
    assert written(tmp_path, ResultFormat.PNG16, alone=True) == [
        "confidence.png",
        "depth.png",
        "disp.png",
        "rig.json",
        "sigma.png",
    ]


def test_results_of_an_earlier_run_are_replaced_and_other_files_stay(tmp_path: Path) -> None:
    written(tmp_path, ResultFormat.PNG16)
    (tmp_path / "0007.pfm").write_bytes(b"an earlier run of another format")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "left.png").write_bytes(b"mine too")
    names = written(tmp_path, ResultFormat.NPZ)
    assert names == ["0003.npz", "left.png", "notes.txt", "rig.json"]


def test_files_that_are_no_results_of_ours_are_not_replaced(tmp_path: Path) -> None:
    images = tmp_path / "image_2"
    images.mkdir()
    (images / "000000.png").write_bytes(b"an image of a data set")
    with pytest.raises(CliError, match=r"image_2 holds 000000\.png.*--out"):
        make_room(images)
    assert (images / "000000.png").exists()
    make_room(tmp_path / "image_2" / "new")


def test_values_that_a_png_cannot_hold_are_counted(tmp_path: Path) -> None:
    files = ResultFolder(tmp_path, outputs=(Output.DEPTH,), form=ResultFormat.PNG16, alone=False)
    files.begin(RIG)
    far = DisparityMap(1, 0, RIG, np.full((9, 12), 0.1, np.float32))  # 400 m
    files.write(0, far)
    files.write(1, a_result())
    assert files.beyond == 9 * 12
    assert not np.isfinite(read_disparity_png(tmp_path / "depth/0000.png")).any()
