"""Whatever is wrong on disk, the error names the file and says what was expected."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support.sources import Change, cut, opening
from vergence_proto.datasets import open_source


def _calib(**values: object) -> Change:
    def change(folder: Path) -> None:
        path = folder / "calib.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    return change


def _without(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def _writing(name: str, text: str) -> Change:
    return lambda folder: (folder / name).write_text(text)


def _image(name: str, width: int, height: int) -> Change:
    return lambda folder: trees.write_image(folder / name, trees.an_image(0, width, height))


def _cut(name: str) -> Change:
    return lambda folder: cut(folder / name)


def _truth(**arrays: object) -> Change:
    return lambda folder: np.savez(folder / "frame_0000_gt.npz", **arrays)  # type: ignore[arg-type]


def _replaced(name: str, old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return change


VERGENCE = [
    ("no calibration", _without("calib.json"), "calib.json: not found"),
    ("broken JSON", _writing("calib.json", "{"), "calib.json: not JSON"),
    ("JSON of another kind", _writing("calib.json", "[]"), "expected a JSON object, got list"),
    ("a word as fx", _calib(fx="wide"), "calib.json: expected a number for 'fx', got 'wide'"),
    ("no baseline", _calib(baseline_m=0), "calib.json: the baseline must be positive"),
    ("negative focal length", _calib(fx=-1), "calib.json: focal lengths must be positive"),
    ("another size", _calib(width=640), "left.png: expected 640x16 as its calibration says"),
    ("frames a second of zero", _calib(fps=0), "calib.json: expected a positive fps"),
    ("no right image", _without("frame_0001_right.png"), "frame_0001_right.png: not found"),
    ("no left image", _without("frame_0000_left.png"), "frame_0000_left.png: not found"),
    ("a small right image", _image("frame_0001_right.png", 20, 16), "right.png: expected 24x16"),
    ("half an image", _cut("frame_0001_left.png"), "frame_0001_left.png: the PNG of"),
    (
        "text as an image",
        _writing("frame_0001_left.png", "hm"),
        "frame_0001_left.png: expected a PNG",
    ),
    ("a short pose", _writing("poses.txt", "1 0 0"), "poses.txt, line 1: expected 12 numbers"),
    ("a pose of words", _writing("poses.txt", "north " * 12), "poses.txt, line 1: could not"),
    ("no rotation", _writing("poses.txt", "1 " * 12), "poses.txt, line 1: expected a rotation"),
    ("half a truth", _cut("frame_0000_gt.npz"), "frame_0000_gt.npz: expected a readable .npz"),
    ("truth without disp", _truth(d=np.zeros(3)), "gt.npz: expected an array 'disp', got d"),
    ("truth in floats", _truth(disp=np.zeros((16, 24))), "expected disp as uint16"),
    ("small truth", _truth(disp=np.zeros((8, 24), np.uint16)), "the truth of frame 1 is 24x8"),
    (
        "a mask of another size",
        _truth(disp=np.zeros((16, 24), np.uint16), vis=np.zeros((16, 9), np.uint8)),
        "gt.npz: expected vis as np.packbits",
    ),
]
KITTI = [
    ("no calibration", _without("calib.txt"), "calib.txt: not found"),
    ("no P3", _replaced("calib.txt", "P3:", "P4:"), "calib.txt: expected a line P3:"),
    ("a short P2", _replaced("calib.txt", "P2: 20", "P2:"), "calib.txt, P2:: expected 12 numbers"),
    ("eyes swapped", _replaced("calib.txt", "-9.4", "9.4"), "calib.txt: the baseline must be"),
    (
        "no focal length",
        _replaced("calib.txt", "P2: 20", "P2: 0"),
        "calib.txt, P2:: expected K [I | t]",
    ),
    ("two times in a line", _writing("times.txt", "0 0.1\n"), "times.txt, line 1: expected 1"),
    ("no right image", _without("image_3/000001.png"), "image_3/000001.png: not found"),
    ("half an image", _cut("image_2/000001.png"), "000001.png: the PNG of"),
]
EUROC = [
    ("no sensor", _without("mav0/cam1/sensor.yaml"), "cam1/sensor.yaml: not found"),
    (
        "an unknown distortion",
        _replaced("mav0/cam0/sensor.yaml", "radial-tangential", "omni"),
        "expected the distortion_model radial-tangential or equidistant, got 'omni'",
    ),
    (
        "no T_BS",
        _replaced("mav0/cam0/sensor.yaml", "data:", "dat:"),
        "sensor.yaml, T_BS: expected numbers",
    ),
    ("short intrinsics", _replaced("mav0/cam0/sensor.yaml", "20.5, ", ""), "expected 4 numbers"),
    (
        "three coefficients",
        _replaced("mav0/cam0/sensor.yaml", "-0.28, ", ""),
        "yaml: brown-conrady",
    ),
    ("another size", _replaced("mav0/cam1/sensor.yaml", "[24", "[25"), "one size"),
    (
        "no images",
        _writing("mav0/cam1/data.csv", "#"),
        "no image of cam1 is less than half a frame from",
    ),
    ("a line of words", _writing("mav0/cam1/data.csv", "5,a\nsoon"), "cam1/data.csv: expected"),
    (
        "a truth line of words",
        _writing("mav0/state_groundtruth_estimate0/data.csv", "12,a,b"),
        "data.csv, 12: could not convert",
    ),
    (
        "no unit quaternion",
        _writing("mav0/state_groundtruth_estimate0/data.csv", "12,1,2,3,2,0,0,0"),
        "data.csv, 12: expected a unit quaternion, got length 2",
    ),
    (
        "a short truth line",
        _writing("mav0/state_groundtruth_estimate0/data.csv", "12,1,2,3"),
        "data.csv, 12: expected p x y z, q w x y z, got 3 numbers",
    ),
    (
        "a truth time of words",
        _writing("mav0/state_groundtruth_estimate0/data.csv", "5,1,2,3,1,0,0,0\nsoon,1"),
        "data.csv: expected 'timestamp, p x y z, q w x y z', got 'soon,1'",
    ),
]
TARTANAIR = [
    ("no poses", _without("pose_left.txt"), "P001: expected pose_left.txt or pose_lcam_front.txt"),
    ("a short pose", _writing("pose_left.txt", "0 0 0 1"), "line 1: expected 7 numbers, got 4"),
    ("no unit quaternion", _writing("pose_left.txt", "0 0 0 0 0 0 0"), "line 1: expected a unit"),
    (
        "half a depth",
        _cut("depth_left/000001_left_depth.npy"),
        "depth.npy: no readable .npy",
    ),
    (
        "flat depth",
        lambda folder: np.save(folder / "depth_left/000001_left_depth.npy", np.zeros(3)),
        "depth.npy: expected depth [H, W], got [3]",
    ),
]
MIDDLEBURY = [
    ("no calibration", _without("calib.txt"), "calib.txt: not found"),
    ("no baseline", _replaced("calib.txt", "baseline", "base"), "expected a line baseline=..."),
    ("a broken camera", _replaced("calib.txt", "[20.5 0 11.25;", "["), "cam0: expected 9 numbers"),
    ("baseline of zero", _replaced("calib.txt", "193.001", "0"), "the baseline must be positive"),
    ("another size", _replaced("calib.txt", "width=24", "width=48"), "im0.png: expected 48x16"),
    ("half a PFM", _cut("disp0.pfm"), "disp0.pfm: 24x16 needs 1536 bytes"),
    ("a colour mask", _image("mask0nocc.png", 24, 16), "mask0nocc.png: expected a grey PNG"),
]


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        pytest.param(kind, change, message, id=f"{kind}, {name}")
        for kind, cases in (
            ("vergence", VERGENCE),
            ("kitti", KITTI),
            ("euroc", EUROC),
            ("tartanair", TARTANAIR),
            ("middlebury", MIDDLEBURY),
        )
        for name, change, message in cases
    ],
)
def test_the_file_is_named(kind: str, change: Change, message: str, tmp_path: Path) -> None:
    folder = trees.TREES[kind](tmp_path)
    list(open_source(f"{kind}:{folder}"))  # it was right before
    change(folder)
    said = opening(f"{kind}:{folder}")
    assert message in said
    assert str(tmp_path) in said or folder.name in said


@pytest.mark.parametrize("year", [2012, 2015])
@pytest.mark.parametrize("missing", ["image", "calibration"])
def test_a_kitti_pair_that_lacks_a_file(year: int, missing: str, tmp_path: Path) -> None:
    path = trees.kitti_pair(tmp_path, year)
    image = "image_1" if year == 2012 else "image_3"
    calib = "calib" if year == 2012 else "calib_cam_to_cam"
    names = {"image": f"{image}/000046_10.png", "calibration": f"{calib}/000046.txt"}
    file = path.parent / names[missing]
    file.unlink()
    assert opening(f"kitti{year}:{path}").startswith(f"{file}: not found")


@pytest.mark.parametrize("year", [2012, 2015])
def test_a_folder_of_kitti_pairs_names_them(year: int, tmp_path: Path) -> None:
    path = trees.kitti_pair(tmp_path, year)
    assert f"name one of them: kitti{year}:{path}" in opening(f"kitti{year}:{tmp_path}/training")


def test_kitti_truth_must_have_sixteen_bits(tmp_path: Path) -> None:
    path = trees.kitti_pair(tmp_path, 2015)
    truth = path.parent / "disp_occ_0" / "000046_10.png"
    trees.write_image(truth, np.zeros((16, 24), np.uint8))
    assert f"{truth}: expected a 16-bit grey PNG" in opening(f"kitti2015:{path}")


def test_tartanair_2_depth_must_have_four_channels(tmp_path: Path) -> None:
    folder = trees.tartanair_trajectory(tmp_path, 2)
    depth = folder / "depth_lcam_front" / "000001_lcam_front_depth.png"
    trees.write_image(depth, trees.an_image(0))
    assert f"{depth}: expected depth as an RGBA PNG" in opening(f"tartanair:{folder}")
