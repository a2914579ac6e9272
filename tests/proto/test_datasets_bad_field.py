"""An error in a data set is one sentence that names the file."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support import field_trees as field
from tests.support.sources import Change, cut, opening
from vergence_proto.datasets import find_sources, open_source


def _without(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def _writing(name: str, text: str) -> Change:
    return lambda folder: (folder / name).write_text(text)


def _grey(name: str) -> Change:
    return lambda folder: trees.write_image(folder / name, np.full((16, 24), 7, np.uint8))


def _colour(name: str) -> Change:
    return lambda folder: trees.write_image(folder / name, trees.an_image(0))


def _cut(name: str) -> Change:
    return lambda folder: cut(folder / name)


def _replaced(name: str, old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return change


def _flat_disparity(folder: Path) -> None:
    np.save(folder / "disp_00.npy", np.zeros(3))


def _small_disparity(folder: Path) -> None:
    np.save(folder / "disp_00.npy", np.ones((8, 24), np.float32))


_SINTEL = "../../disparities/alley_1/frame_0001.png"
_CAM = "../../camdata_left/alley_1/frame_0001.cam"
_VKITTI_DEPTH = "frames/depth/Camera_0/depth_00000.png"
_DRIVE_CALIB = f"../../calib/half-image-calib/{field.DRIVE}.txt"
_DRIVE_TRUTH = f"../../train-disparity-map/{field.DRIVE}/{field.DRIVE}_2018-07-09-16-11-56-502.png"
_KITTI_DEPTH = "proj_depth/groundtruth/image_02/0000000000.png"
_KITTI_OXTS = "oxts/data/0000000001.txt"

CASES: dict[str, list[tuple[str, Change, str]]] = {
    "sintel": [
        ("no right image", _without("../../final_right/alley_1/frame_0002.png"), "not found"),
        ("grey truth", _grey(_SINTEL), "frame_0001.png: expected disparity packed in RGB"),
        ("half a camera", _cut(_CAM), "frame_0001.cam: expected 172 bytes that start with"),
        ("a text camera", _writing(_CAM, "hm" * 86), "got 172 bytes starting b'hmhm'"),
    ],
    "spring": [
        ("a short pose", _writing("cam_data/extrinsics.txt", "1 0 0"), "line 1: expected 16"),
        (
            "no rotation",
            _writing("cam_data/extrinsics.txt", "1 " * 12 + "0 0 0 1"),
            "txt, line 1: expected a rotation",
        ),
        (
            "a transposed pose",
            _writing("cam_data/extrinsics.txt", "1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1"),
            "txt, line 1: expected 0 0 0 1 as the last row",
        ),
        ("words", _writing("cam_data/intrinsics.txt", "1 2 3 wide"), "txt, line 1: could not"),
        ("no numbers", _writing("cam_data/intrinsics.txt", ""), "got an empty file"),
        ("focal length", _writing("cam_data/intrinsics.txt", "0 0 1 1"), "must be positive"),
        ("no right image", _without("frame_right/frame_right_0002.png"), "0002.png: not found"),
    ],
    "vkitti2": [
        ("8-bit depth", _grey(_VKITTI_DEPTH), "expected a 16-bit PNG of centimetres, got uint8"),
        ("coloured depth", _colour(_VKITTI_DEPTH), "expected a grey image, got [16, 24, 3]"),
        ("no camera 0", _writing("intrinsic.txt", "0 1 30 31 12 8"), "lines with cameraID 0"),
        ("a short line", _writing("extrinsic.txt", "0 0 1 0"), "line 1: expected 18 numbers"),
        ("no right image", _without("frames/rgb/Camera_1/rgb_00001.png"), "not found"),
    ],
    "booster": [
        ("no XML", _writing("calib_00-02.xml", "f: 3"), "calib_00-02.xml: expected OpenCV's XML"),
        ("no baseline", _replaced("calib_00-02.xml", "baselineLR", "b"), "expected <baselineLR>"),
        ("no camera", _replaced("calib_00-02.xml", "proj_matR", "b"), "expected <proj_matR>"),
        ("half a truth", _cut("disp_00.npy"), "disp_00.npy: no readable .npy"),
        ("flat truth", _flat_disparity, "disp_00.npy: expected disparity [H, W], got [3]"),
        ("small truth", _small_disparity, "the truth of frame 1 is 24x8"),
        ("coloured mask", _colour("mask_00.png"), "mask_00.png: expected a grey image"),
    ],
    "instereo2k": [
        ("no right image", _without("right.png"), "right.png: not found; expected the right"),
        ("8-bit truth", _grey("left_disp.png"), "expected a 16-bit grey image (disparity x100)"),
    ],
    "drivingstereo": [
        ("no T_103", _replaced(_DRIVE_CALIB, "T_103", "T_104"), "expected a line T_103:"),
        ("a short line", _replaced(_DRIVE_CALIB, "-0.54", ""), "T_103: expected 3 numbers, got 2"),
        ("8-bit truth", _grey(_DRIVE_TRUTH), "expected a 16-bit grey image (disparity x256)"),
    ],
    "middlebury2006": [
        ("words for dmin", _writing("dmin.txt", "wide"), "dmin.txt: could not convert"),
        (
            "16-bit truth",
            lambda folder: trees.write_image(folder / "disp1.png", np.full((16, 24), 7, np.uint16)),
            "disp1.png: expected a 8-bit grey image (disparity x2), got uint16",
        ),
    ],
    "kittiraw": [
        ("a short reading", _writing(_KITTI_OXTS, "49 8 100"), "expected 30 numbers, got 3"),
        ("a time of words", _writing("image_02/timestamps.txt", "soon"), "got 'soon'"),
        (
            "no projection",
            _replaced("../calib_cam_to_cam.txt", "P_rect_03", "P_rect_04"),
            "calib_cam_to_cam.txt: expected a line P_rect_03:",
        ),
        ("no T", _writing("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 1"), "lines R: and T:"),
        ("8-bit depth", _grey(_KITTI_DEPTH), "expected a 16-bit PNG (metres x256), got uint8"),
    ],
    "flyingthings": [
        ("half a PFM", _cut("../../disparity/left/0000012.pfm"), "24x16 needs 1536 bytes"),
        ("no right image", _without("../right/0000012.png"), "0000012.png: not found"),
    ],
    "irs": [
        ("text as EXR", _writing("d_8.exr", "hm"), "d_8.exr: expected OpenEXR, got a file"),
        ("half an EXR", _cut("d_8.exr"), "d_8.exr: a damaged OpenEXR file"),
        ("no right image", _without("r_9.png"), "r_9.png: not found"),
    ],
    "apollo": [
        ("no K", _writing("intrinsic.txt", "f 30"), "intrinsic.txt: expected K = [...]"),
        (
            "8-bit truth",
            _grey("disparity/171206_034625454_Camera_5.png"),
            "Camera_5.png: expected a 16-bit grey image (disparity x256), got uint8",
        ),
        (
            "no time",
            lambda folder: (folder / "camera_5/171206_034625454_Camera_5.png").rename(
                folder / "camera_5/171306_034625454_Camera_5.png"
            ),
            "171306_034625454_Camera_5.png: expected a time in the name",
        ),
    ],
}


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        pytest.param(kind, change, message, id=f"{kind}, {name}")
        for kind, cases in CASES.items()
        for name, change, message in cases
    ],
)
def test_the_file_is_named(kind: str, change: Change, message: str, tmp_path: Path) -> None:
    path = field.TREES[kind](tmp_path)
    list(open_source(f"{kind}:{path}"))  # it was right before
    # A pair of FlyingThings3D is a number and no folder; a folder is what ".." starts from.
    change(path if path.is_dir() else path.parent / "left")
    said = opening(f"{kind}:{path}")
    assert message in said
    assert str(tmp_path) in said or path.name in said
    assert "\n" not in said


@pytest.mark.parametrize("kind", field.TREES)
def test_an_empty_folder_says_what_was_expected(kind: str, tmp_path: Path) -> None:
    assert find_sources(f"{kind}:{tmp_path}") == []
    said = opening(f"{kind}:{tmp_path}")
    assert str(tmp_path) in said
    assert "expected" in said


@pytest.mark.parametrize("kind", field.TREES)
def test_a_folder_above_names_what_it_holds(kind: str, tmp_path: Path) -> None:
    path = field.TREES[kind](tmp_path)
    assert f"name one of them: {kind}:{path}" in opening(f"{kind}:{tmp_path}")


def test_springs_truth_without_h5py_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)  # as Python marks a module that is not there
    folder = field.spring_sequence(tmp_path)
    truth = folder / "disp1_left" / "disp1_left_0001.dsp5"
    truth.parent.mkdir()
    truth.write_bytes(b"\x89HDF\r\n\x1a\n")
    assert opening(f"spring:{folder}") == (
        f"{truth}: reading Spring's disparity needs h5py, which is not installed: pip install h5py"
    )


def test_an_exr_that_nothing_here_decodes_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "OpenEXR", None)  # as Python marks a module that is not there
    folder = field.irs_scene(tmp_path)
    path = folder / "d_8.exr"
    data = bytearray(path.read_bytes())
    name = data.index(b"compression\0compression\0")
    data[name + 24 + 4] = 4  # PIZ
    path.write_bytes(data)
    assert opening(f"irs:{folder}").startswith(f"{path}: this kind of OpenEXR file needs the")


def test_images_of_unknown_size_need_their_scale(tmp_path: Path) -> None:
    scene = field.middlebury2006_scene(tmp_path)
    moved = tmp_path / "Aloe"
    scene.rename(moved)
    assert f"add it: middlebury2006:{moved}?scale=N" in opening(f"middlebury2006:{moved}")
    assert open_source(f"middlebury2006:{moved}?scale=2")[0].truth_px is not None
