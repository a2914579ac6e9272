"""Tiny data sets of the field, written as their publishers lay them out."""

import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.support.dataset_trees import (
    HEIGHT,
    WIDTH,
    a_disparity,
    an_image,
    some_poses,
    words,
    write_image,
    write_lines,
    write_pfm_by_hand,
)
from vergence.recording import SessionRecording
from vergence.results import DepthResult
from vergence_proto import codec
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import ImageEncoding, OutputFormat, Plane, StereoFrame, StereoRig
from vergence_proto.v1 import depth_pb2 as pb

HIDDEN = np.zeros((HEIGHT, WIDTH), np.bool_)  # what the right camera does not see
HIDDEN[4:7, :3] = True


def _pair(left: Path, right: Path, seed: int) -> None:
    write_image(left, an_image(seed))
    write_image(right, an_image(50 + seed))


def _stored(disparity_px: Plane, steps_per_px: float) -> NDArray[np.uint16]:
    return np.asarray(np.rint(np.nan_to_num(disparity_px) * steps_per_px), np.uint16)


def _hidden_png(path: Path) -> None:
    write_image(path, np.where(HIDDEN, 255, 0).astype(np.uint8))


def _camera_lines(numbers: Iterable[Matrix | list[float]]) -> list[str]:
    return [words(each) for each in numbers]


def sintel_disparity() -> Plane:
    """Reaches beyond 4 px and holds a step of 2^-14, so that all three bytes are used."""
    disparity_px = np.nan_to_num(a_disparity(), nan=700.25).astype(np.float32)
    disparity_px[1, 1] = 5 + 3 / 2**14
    return disparity_px


def sintel_scene(root: Path, name: str = "final_left", count: int = 3) -> Path:
    split = root / "training"
    folder = split / name / "alley_1"
    right = split / name.replace("left", "right") / "alley_1"
    for k, pose in enumerate(some_poses(count), start=1):
        file = f"frame_{k:04d}.png"
        _pair(folder / file, right / file, k)
        # In steps of 2^-14: R counts 4 px, G 2^-6 px, B 2^-14 px.
        steps = np.rint(sintel_disparity().astype(np.float64) * 2**14).astype(np.int64)
        red, rest = np.divmod(steps, 4 * 2**14)
        green, blue = np.divmod(rest, 2**8)
        packed = np.stack([red, green, blue], axis=-1).astype(np.uint8)
        write_image(split / "disparities" / "alley_1" / file, packed)
        _hidden_png(split / "occlusions" / "alley_1" / file)
        write_image(split / "outofframe" / "alley_1" / file, np.zeros((HEIGHT, WIDTH), np.uint8))
        camera = split / "camdata_left" / "alley_1" / f"frame_{k:04d}.cam"
        camera.parent.mkdir(parents=True, exist_ok=True)
        intrinsics = np.array([[30.0, 0, 12], [0, 31, 8], [0, 0, 1]])
        camera_from_world = pose.inverse().matrix[:3]
        numbers = np.concatenate([intrinsics.ravel(), camera_from_world.ravel()])
        camera.write_bytes(struct.pack("<f", 202021.25) + numbers.astype("<f8").tobytes())
    return folder


def spring_sequence(root: Path, count: int = 3) -> Path:
    """Without its truth, which is HDF5."""
    folder = root / "spring" / "train" / "0001"
    for k in range(1, count + 1):
        _pair(
            folder / "frame_left" / f"frame_left_{k:04d}.png",
            folder / "frame_right" / f"frame_right_{k:04d}.png",
            k,
        )
    poses = some_poses(count)
    write_lines(folder / "cam_data" / "intrinsics.txt", *["30 31 12 8"] * count)
    write_lines(
        folder / "cam_data" / "extrinsics.txt",
        *_camera_lines(pose.inverse().matrix for pose in poses),
    )
    write_lines(folder / "cam_data" / "focaldistance.txt", *["10"] * count)
    return folder


def vkitti2_depth_cm() -> NDArray[np.uint16]:
    """Whole centimetres; the first row's start is the sky."""
    rng = np.random.default_rng(3)
    depth_cm = rng.integers(200, 8000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth_cm[0, :5] = 65535
    return depth_cm


def vkitti2_scene(root: Path, count: int = 3, archives: bool = False) -> Path:
    rgb, depth, text = (
        root / (f"vkitti_2.0.3_{kind}" if archives else "") / "Scene01" / "clone"
        for kind in ("rgb", "depth", "textgt")
    )
    intrinsics = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    extrinsics = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"]
    for k, pose in enumerate(some_poses(count)):
        frames = rgb / "frames" / "rgb"
        _pair(frames / "Camera_0" / f"rgb_{k:05d}.png", frames / "Camera_1" / f"rgb_{k:05d}.png", k)
        write_image(
            depth / "frames" / "depth" / "Camera_0" / f"depth_{k:05d}.png", vkitti2_depth_cm()
        )
        for camera in (0, 1):
            moved = pose @ Pose(np.eye(3), np.array([0.532725 * camera, 0, 0]))
            intrinsics.append(f"{k} {camera} 30 31 12 8")
            extrinsics.append(f"{k} {camera} {words(moved.inverse().matrix)}")
    write_lines(text / "intrinsic.txt", *intrinsics)
    write_lines(text / "extrinsic.txt", *extrinsics)
    return rgb


def booster_scene(root: Path, count: int = 3) -> Path:
    folder = root / "train" / "balanced" / "Bathroom"
    for k in range(count):
        _pair(folder / "camera_00" / f"im{k}.png", folder / "camera_02" / f"im{k}.png", k)
    np.save(folder / "disp_00.npy", np.nan_to_num(a_disparity()))
    write_image(folder / "mask_00.png", np.where(HIDDEN, 0, 255).astype(np.uint8))

    def matrix(name: str, numbers: list[float]) -> list[str]:
        return [
            f'<{name} type_id="opencv-matrix">',
            "  <rows>3</rows>",
            "  <cols>4</cols>",
            "  <dt>d</dt>",
            "  <data>",
            f"    {words(numbers[:7])}",
            f"    {words(numbers[7:])}</data></{name}>",
        ]

    write_lines(
        folder / "calib_00-02.xml",
        '<?xml version="1.0"?>',
        "<opencv_storage>",
        *matrix("proj_matL", [30, 0, 12, 0, 0, 31, 8, 0, 0, 0, 1, 0]),
        *matrix("proj_matR", [30, 0, 12.5, -2400, 0, 31, 8, 0, 0, 0, 1, 0]),
        "<baselineLR>80.</baselineLR>",
        "</opencv_storage>",
    )
    return folder


def instereo2k_pair(root: Path) -> Path:
    folder = root / "train" / "part1" / "000000"
    _pair(folder / "left.png", folder / "right.png", 1)
    write_image(folder / "left_disp.png", _stored(a_disparity(), 100))
    return folder


DRIVE = "2018-07-09-16-11-56"
DRIVE_START_NS = 1531152716_502_000_000  # 2018-07-09 16:11:56.502 UTC


def drivingstereo_drive(root: Path, count: int = 3) -> Path:
    for k in range(count):
        name = f"{DRIVE}_2018-07-09-16-11-56-{502 + 100 * k}"
        _pair(
            root / "train-left-image" / DRIVE / f"{name}.png",
            root / "train-right-image" / DRIVE / f"{name}.png",
            k,
        )
        truth = root / "train-disparity-map" / DRIVE / f"{name}.png"
        write_image(truth, _stored(a_disparity(k), 256))
    _drivingstereo_calib(root / "calib" / "half-image-calib")
    return root / "train-left-image" / DRIVE


def drivingstereo_weather(root: Path, size: str) -> Path:
    """Foggy, of all drives in one folder."""
    folder = root / "foggy"
    for drive in (DRIVE, "2018-10-25-07-37-52"):
        name = f"{drive}_{drive}-438"
        _pair(
            folder / f"left-image-{size}-size" / f"{name}.png",
            folder / f"right-image-{size}-size" / f"{name}.png",
            7,
        )
        write_image(
            folder / f"disparity-map-{size}-size" / f"{name}.png",
            _stored(a_disparity(7), 256 if size == "half" else 128),
        )
    return folder / f"left-image-{size}-size" / DRIVE


def _drivingstereo_calib(folder: Path) -> None:
    write_lines(
        folder / f"{DRIVE}.txt",
        "calib_time: 2018-07-09-16-11-56",
        "S_101: 1758 800",
        "T_101: 0 0 0",
        f"P_rect_101: {words([30, 0, 12, 0, 0, 31, 8, 0, 0, 0, 1, 0])}",
        "T_103: -0.54 0.03 0.04",
        f"P_rect_103: {words([30, 0, 12.5, -32.5, 0, 31, 8, 0, 0, 0, 1, 0])}",
    )


def grey_disparity(scale: int) -> tuple[NDArray[np.uint8], Plane]:
    """What is stored, and what it means in pixels."""
    stored = np.random.default_rng(scale).integers(1, 256, (HEIGHT, WIDTH)).astype(np.uint8)
    stored[0, :5] = 0
    disparity_px = (stored / scale).astype(np.float32)
    disparity_px[0, :5] = np.nan
    return stored, disparity_px


def middlebury2006_scene(root: Path) -> Path:
    folder = root / "HalfSize" / "Aloe"
    _pair(folder / "view1.png", folder / "view5.png", 1)
    write_image(folder / "disp1.png", grey_disparity(2)[0])
    write_lines(folder / "dmin.txt", "270")
    return folder


OXTS_LATITUDE, OXTS_LONGITUDE = 49.0, 8.4


def kittiraw_drive(root: Path, count: int = 3) -> Path:
    """Drives 2 m to the north a frame, the IMU facing north; no offsets but those of the files."""
    date = root / "2011_09_26"
    folder = date / "2011_09_26_drive_0001_sync"
    for k in range(count):
        name = f"{k:010d}.png"
        _pair(folder / "image_02" / "data" / name, folder / "image_03" / "data" / name, k)
        latitude = OXTS_LATITUDE + math.degrees(2.0 * k / 6378137.0)
        fix = [latitude, OXTS_LONGITUDE, 100.0, 0, 0, math.pi / 2, *[0.0] * 19, *[4.0] * 5]
        write_lines(folder / "oxts" / "data" / f"{k:010d}.txt", " ".join(map(repr, fix)))
        depth = folder / "proj_depth" / "groundtruth" / "image_02" / name
        write_image(depth, vkitti2_depth_cm() // 2)
    write_lines(
        folder / "image_02" / "timestamps.txt",
        *(f"2011-09-26 13:02:25.{100_000_000 * k + 445:09d}" for k in range(count)),
    )
    write_lines(
        date / "calib_cam_to_cam.txt",
        "calib_time: 09-Jan-2012 13:57:47",
        "corner_dist: 9.950000e-02",
        f"R_rect_00: {words(np.eye(3))}",
        f"P_rect_02: {words([20, 0, 11, 1.2, 0, 20, 7, 0, 0, 0, 1, 0])}",
        f"P_rect_03: {words([20, 0, 11.5, -9.6, 0, 20, 7, 0, 0, 0, 1, 0])}",
    )
    # A camera's right, down, forward are the scanner's -y, -z, x.
    axes = [0.0, -1, 0, 0, 0, -1, 1, 0, 0]
    write_lines(date / "calib_velo_to_cam.txt", f"R: {words(axes)}", "T: 0 0 -0.25")
    write_lines(date / "calib_imu_to_velo.txt", f"R: {words(np.eye(3))}", "T: -0.5 0 0")
    return folder


def kittiraw_poses(count: int = 3) -> list[Pose]:
    """From the sketch: the camera stands 0.75 m ahead of the IMU, and 0.06 m left of cam0's axis.

    Facing north, its right is east, its down is down, its forward north.
    """
    rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return [Pose(rotation, np.array([-0.06, 0.75 + 2.0 * k, 0])) for k in range(count)]


def flyingthings_pair(root: Path) -> Path:
    split = root / "FlyingThings3D_subset" / "train"
    name = "0000012.png"
    _pair(split / "image_clean" / "left" / name, split / "image_clean" / "right" / name, 12)
    truth = split / "disparity" / "left" / "0000012.pfm"
    write_pfm_by_hand(truth, -a_disparity(12))
    _hidden_png(split / "disparity_occlusions" / "left" / name)
    return split / "image_clean" / "0000012"


def irs_scene(root: Path, count: int = 3) -> Path:
    folder = root / "Home" / "ArchVizInterior03Data"
    for k in range(8, 8 + count):  # 9 comes before 10
        _pair(folder / f"l_{k}.png", folder / f"r_{k}.png", k)
        write_exr(folder / f"d_{k}.exr", np.nan_to_num(a_disparity(k)), compression=3)
    return folder


def write_exr(path: Path, values: Plane, *, compression: int, name: str = "G") -> None:
    """One float channel in scan lines: compression 0 is none, 2 ZIP by line, 3 ZIP by 16 lines."""
    height, width = values.shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = name.encode() + b"\0" + struct.pack("<iBxxxii", 2, 0, 1, 1) + b"\0"
    attributes = (
        ("channels", "chlist", channel),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", box),
        ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    )
    header = struct.pack("<II", 20000630, 2) + b"".join(
        key.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
        for key, kind, data in attributes
    )
    header += b"\0"
    lines = 16 if compression == 3 else 1
    blocks = []
    for y in range(0, height, lines):
        raw = values[y : y + lines].astype("<f4").tobytes()
        packed = _exr_zipped(raw) if compression else raw
        packed = packed if len(packed) < len(raw) else raw
        blocks.append(struct.pack("<ii", y, len(packed)) + packed)
    starts, at = [], len(header) + 8 * len(blocks)
    for block in blocks:
        starts.append(at)
        at += len(block)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + struct.pack(f"<{len(starts)}Q", *starts) + b"".join(blocks))


def _exr_zipped(raw: bytes) -> bytes:
    """Even bytes before odd ones, then the differences plus 128, then deflate."""
    halves = raw[0::2] + raw[1::2]
    steps = [halves[0]]
    steps += [(b - a + 128) % 256 for a, b in itertools.pairwise(halves)]
    return zlib.compress(bytes(steps))


APOLLO_START_NS = 1512531985_454_000_000  # 2017-12-06 03:46:25.454 UTC


def apollo_recording(root: Path, count: int = 3, steps_per_px: float = 256) -> Path:
    folder = root / "stereo_train_001"
    for k in range(count):
        stem = f"171206_0346{25 + k}454_Camera"
        _pair(folder / "camera_5" / f"{stem}_5.png", folder / "camera_6" / f"{stem}_6.png", k)
        truth = _stored(a_disparity(k), steps_per_px)
        write_image(folder / "disparity" / f"{stem}_5.png", truth)
        foreground = np.zeros((HEIGHT, WIDTH), np.uint8)
        foreground[:2] = 1
        write_image(folder / "fg_mask" / f"{stem}_5.png", foreground)
        write_image(folder / "bg_mask" / f"{stem}_5.png", np.where(HIDDEN, 0, 1).astype(np.uint8))
    write_lines(folder / "intrinsic.txt", "K = [30, 0, 12; 0, 31, 8; 0, 0, 1]")
    return folder


def mcap_recording(root: Path, count: int = 3) -> Path:
    """A session that was recorded: the messages that a server would have sent and received."""
    rig = RectifiedRig(WIDTH, HEIGHT, 20, 20, 11.5, 11.5, 7.5, 0.1)
    opening = pb.OpenStream(rig=codec.rig_to_proto(StereoRig.from_rectified(rig)))
    opened = pb.StreamOpened(rig=codec.rectified_rig_to_proto(rig))
    path = root / "walk.mcap"
    root.mkdir(parents=True, exist_ok=True)
    with SessionRecording(path, opening, opened) as recording:
        for frame_id in range(1, count + 1):
            left, right = an_image(frame_id), an_image(50 + frame_id)
            frame = StereoFrame(frame_id, frame_id * 40_000_000, left, right)
            recording.sent(frame_id, codec.frame_to_request(frame, encoding=ImageEncoding.RAW))
            result = DepthResult(frame_id, frame.capture_ns, rig, a_disparity(frame_id))
            recording.answered(codec.disparity_to_proto(result, OutputFormat()), result)
    return path


TREES: dict[str, Callable[[Path], Path]] = {
    "mcap": mcap_recording,
    "sintel": sintel_scene,
    "spring": spring_sequence,
    "vkitti2": vkitti2_scene,
    "booster": booster_scene,
    "instereo2k": instereo2k_pair,
    "drivingstereo": drivingstereo_drive,
    "middlebury2006": middlebury2006_scene,
    "kittiraw": kittiraw_drive,
    "flyingthings": flyingthings_pair,
    "irs": irs_scene,
    "apollo": apollo_recording,
}
