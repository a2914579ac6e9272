"""Every layout of a result states the same depth at the same place, in its own conventions."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vergence_proto.datasets import read_disparity_png, read_pfm
from vergence_proto.errors import BadImage, BadShape
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.job_results.folders import RESULT_LAYOUTS
from vergence_proto.job_results.folders.base import About
from vergence_proto.job_results.frame_file import JobFrame, decode_frame, encode_frame, is_whole
from vergence_proto.job_results.manifest import about_of
from vergence_proto.job_results.points import points_of
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.jobs import ResultFormat
from vergence_proto.types import DisparityMap

RIG = RectifiedRig(
    width=32, height=24, fx=30.0, fy=31.0, cx_left=15.5, cx_right=14.0, cy=11.0, baseline_m=0.1
)
RNG = np.random.default_rng(3)
OUTPUTS = ["disparity", "depth", "confidence", "sigma", "left", "points"]


def made_frame(index: int, *, posed: bool = True, lost: bool = False) -> JobFrame:
    disparity_px = RNG.uniform(1.5, 8, (RIG.height, RIG.width)).astype(np.float32)
    disparity_px[:3] = np.nan
    pose = Pose.from_xyzw(RNG.normal(size=4), RNG.normal(size=3)) if posed else None
    left = RNG.integers(0, 255, (RIG.height, RIG.width, 3), np.uint8)
    disparity = DisparityMap(
        index + 1,
        10**18 + index * 33_333_333,
        RIG,
        disparity_px,
        sigma_px=disparity_px / np.float32(7),
        confidence=np.full(disparity_px.shape, 200, np.uint8),
        world_from_left=pose,
    )
    record = FrameRecord(
        index=index,
        left=f"l{index}.png",
        right=f"r{index}.png",
        capture_ns=disparity.capture_ns,
        error="cut short" if lost else None,
        world_from_left=None if lost else pose,
    )
    if lost:
        return decode_frame(encode_frame(record, None), RIG)
    file = cv2.imencode(".png", cv2.cvtColor(left, cv2.COLOR_RGB2BGR))[1].tobytes()
    data = encode_frame(record, disparity, confidence=True, sigma=True, left=file)
    return decode_frame(data, RIG)


FRAMES = [made_frame(0), made_frame(1, posed=False), made_frame(2, lost=True), made_frame(3)]
POSED = [FRAMES[0], FRAMES[3]]


def about(*outputs: str) -> About:
    return about_of(
        {
            "rig": asdict(RIG),
            "source": "middlebury:Motorcycle-perfect",
            "options": {"output": outputs or OUTPUTS},
            "counts": {"frames": 4},
            "times": {"frames_per_s": 4.0},
        }
    )


def files_of(form: ResultFormat, *outputs: str) -> dict[str, bytes]:
    layout = RESULT_LAYOUTS[form](about(*outputs))
    files = [file for frame in FRAMES for file in layout.frame(frame)]
    return dict([*files, *layout.end()])


def image(content: bytes) -> NDArray[Any]:
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    return decoded


def depth_of(frame: JobFrame) -> NDArray[np.float32]:
    assert frame.disparity is not None
    return np.nan_to_num(frame.disparity.depth_m)


def points(depth_m: NDArray[Any], camera: list[float], world: NDArray[Any]) -> NDArray[np.float64]:
    """Points by the formula of tools whose pixel centres lie at halves, OpenCV camera axes."""
    fx, fy, cx, cy = camera
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u]
    xyz = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z, np.ones_like(z)])
    return np.asarray((world @ xyz)[:3].T)


@pytest.mark.parametrize("form", [*RESULT_LAYOUTS], ids=str)
def test_every_layout_has_its_manifest_and_a_line_for_every_frame(form: ResultFormat) -> None:
    files = files_of(form)
    manifest = json.loads(files["manifest.json"])
    for kind in manifest["files"]:
        assert kind["path"]
        assert kind["content"]
    lines = [FrameRecord.from_json(line) for line in files["frames.jsonl"].splitlines()]
    assert [line.index for line in lines] == [0, 1, 2, 3]
    assert [line.error for line in lines] == [None, None, "cut short", None]
    for line, frame in zip(lines, FRAMES, strict=True):
        expected = frame.record.world_from_left
        if expected is None:
            assert line.world_from_left is None
        else:
            assert line.world_from_left is not None
            np.testing.assert_array_equal(line.world_from_left.matrix, expected.matrix)
    assert RectifiedRig(**json.loads(files["rig.json"])) == RIG


def test_nerfstudio_puts_every_point_where_it_is() -> None:
    files = files_of(ResultFormat.NERFSTUDIO)
    scene = json.loads(files["transforms.json"])
    camera = [scene[name] for name in ("fl_x", "fl_y", "cx", "cy")]
    assert len(scene["frames"]) == len(POSED)
    assert json.loads(files["manifest.json"])["frames_left_out"] == 1  # the one without a pose
    for entry, frame in zip(scene["frames"], POSED, strict=True):
        stored = image(files[entry["depth_file_path"]])
        assert stored.dtype == np.uint16
        assert np.abs(stored / 1000 - depth_of(frame)).max() <= 0.5e-3 + 1e-6
        opencv_camera = np.array(entry["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        expected, _ = points_of(frame)
        found = points(depth_of(frame), camera, opencv_camera)
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert files[entry["file_path"]] == frame.left


def test_colmap_puts_every_point_where_it_is() -> None:
    files = files_of(ResultFormat.COLMAP)
    _, model, width, height, *camera = files["sparse/0/cameras.txt"].split()
    assert (model, int(width), int(height)) == (b"PINHOLE", RIG.width, RIG.height)
    rows = [line.split() for line in files["sparse/0/images.txt"].decode().splitlines()[::2]]
    for row, frame in zip(rows, POSED, strict=True):
        w, x, y, z, *translation_m = map(float, row[1:8])
        left_from_world = Pose.from_xyzw([x, y, z, w], translation_m)  # type: ignore[arg-type] # lists are taken
        stored = files[f"stereo/depth_maps/{row[9]}.geometric.bin"]
        size, _, planes = stored.partition(f"{RIG.width}&{RIG.height}&1&".encode())
        assert size == b""
        depth_m = np.frombuffer(planes, "<f4").reshape(RIG.height, RIG.width)
        np.testing.assert_array_equal(depth_m, depth_of(frame))
        found = points(depth_m, [*map(float, camera)], left_from_world.inverse().matrix)
        np.testing.assert_allclose(found, points_of(frame)[0], atol=1e-5)
        assert files[f"images/{row[9]}"] == frame.left


def test_tum_has_depth_in_steps_of_a_fifth_of_a_millimetre_and_exact_times() -> None:
    files = files_of(ResultFormat.TUM)
    made = [frame for frame in FRAMES if frame.disparity is not None]
    listed = files["depth.txt"].decode().splitlines()[1:]
    for line, frame in zip(listed, made, strict=True):
        stamp, name = line.split()
        assert stamp.replace(".", "") == str(frame.record.capture_ns)
        assert np.abs(image(files[name]) / 5000 - depth_of(frame)).max() <= 0.1e-3 + 1e-6
        assert f"rgb/{stamp}.png" in files
    rows = [line.split() for line in files["groundtruth.txt"].decode().splitlines()[1:]]
    for row, frame in zip(rows, POSED, strict=True):
        pose = Pose.from_xyzw(*np.split(np.array(row[1:], float), [3])[::-1])
        assert frame.record.world_from_left is not None
        np.testing.assert_allclose(pose.matrix, frame.record.world_from_left.matrix, atol=1e-12)


def test_kitti_is_read_back(tmp_path: Path) -> None:
    files = files_of(ResultFormat.KITTI)
    (tmp_path / "d.png").write_bytes(files["disp_0/000003_10.png"])
    disparity = FRAMES[3].disparity
    assert disparity is not None
    np.testing.assert_allclose(read_disparity_png(tmp_path / "d.png"), disparity.offset_px, 1e-6)
    rows = [list(map(float, line.split())) for line in files["poses.txt"].splitlines()]
    for row, frame in zip(rows, POSED, strict=True):
        assert frame.record.world_from_left is not None
        np.testing.assert_array_equal(row, frame.record.world_from_left.matrix[:3].ravel())
    right = [float(word) for word in files["calib.txt"].splitlines()[1].split()[1:]]
    assert -right[3] / right[0] == pytest.approx(RIG.baseline_m)


def test_submissions_have_the_names_that_benchmarks_want(tmp_path: Path) -> None:
    disparity = FRAMES[0].disparity
    assert disparity is not None
    for form, map_name, time_name, text in (
        (ResultFormat.MIDDLEBURY, "{}/disp0Vergence.pfm", "{}/timeVergence.txt", b"0.250000\n"),
        (ResultFormat.ETH3D, "low_res_two_view/{}.pfm", "low_res_two_view/{}.txt", b"runtime 0.25"),
    ):
        files, scene = files_of(form), "Motorcycle-perfect_0000"
        (tmp_path / "m.pfm").write_bytes(files[map_name.format(scene)])
        np.testing.assert_array_equal(read_pfm(tmp_path / "m.pfm"), disparity.offset_px)
        assert files[time_name.format(scene)].startswith(text)


def test_points_have_the_colours_of_the_left_image() -> None:
    ply = files_of(ResultFormat.NPZ)["points/0000.ply"]
    header, _, body = ply.partition(b"end_header\n")
    assert b"world coordinates" in header
    vertices = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    xyz_m, rgb = points_of(FRAMES[0])
    np.testing.assert_array_equal(vertices["xyz"], xyz_m)
    assert FRAMES[0].left is not None
    colours = image(FRAMES[0].left)[..., ::-1]
    np.testing.assert_array_equal(vertices["rgb"], colours[3:].reshape(-1, 3))
    np.testing.assert_array_equal(rgb, vertices["rgb"])


@pytest.mark.parametrize(
    "form", [ResultFormat.NERFSTUDIO, ResultFormat.COLMAP, ResultFormat.TUM], ids=str
)
def test_a_layout_with_images_says_when_the_job_kept_none(form: ResultFormat) -> None:
    with pytest.raises(BadShape, match="output=left"):
        files_of(form, "disparity")


def flipped(data: bytes) -> bytes:
    changed = bytearray(data)
    changed[-20] ^= 1
    return bytes(changed)


@pytest.mark.parametrize(
    "spoil",
    [lambda data: data[:-1], lambda data: data[:30], flipped, lambda _: b""],
    ids=["cut", "cut in the record", "flipped", "empty"],
)
def test_a_damaged_frame_is_never_a_map(spoil: Callable[[bytes], bytes]) -> None:
    frame = FRAMES[0]
    data = encode_frame(frame.record, frame.disparity, sigma=True)
    assert is_whole(data)
    assert not is_whole(spoil(data))
    with pytest.raises(BadImage):
        decode_frame(spoil(data), RIG)
