"""Tiny data sets, written in the layouts that the readers must read."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.support.strategies import rotation_about
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import Image, Plane

WIDTH, HEIGHT = 24, 16


def an_image(seed: int, width: int = WIDTH, height: int = HEIGHT) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def write_image(path: Path, image: NDArray[np.generic]) -> None:
    """Write RGB, grey or 16-bit grey as the suffix says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    turned = image[..., ::-1] if image.ndim == 3 else image
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if path.suffix == ".webp" else []  # 101: lossless
    assert cv2.imwrite(str(path), np.ascontiguousarray(turned), options)


def write_lines(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def a_disparity(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> Plane:
    """Sixty-fourths of a pixel with a hole in the first row."""
    rng = np.random.default_rng(seed)
    disparity_px = (rng.integers(64, 640, (height, width)) / 64).astype(np.float32)
    disparity_px[0, :5] = np.nan
    return disparity_px


def some_poses(count: int) -> list[Pose]:
    """world_from_left: a turn to the right while walking forward, in OpenCV axes."""
    return [
        Pose(rotation_about((0.1, 1, 0.2), 0.1 * k), np.array([0.3 * k, -0.1 * k, 0.5 * k]))
        for k in range(count)
    ]


def words(numbers: Matrix | list[float]) -> str:
    return " ".join(f"{number:.12g}" for number in np.ravel(numbers))


def xyzw_of(rotation: Matrix) -> Matrix:
    """By the rotation's axis and angle, not by the code under test."""
    axis_angle = np.ravel(cv2.Rodrigues(rotation)[0])
    angle = float(np.linalg.norm(axis_angle))
    axis = axis_angle / angle if angle else np.zeros(3)
    return np.array([*np.sin(angle / 2) * axis, np.cos(angle / 2)])


def vergence_sequence(root: Path, count: int = 3) -> Path:
    folder = root / "room"
    for k in range(count):
        write_image(folder / f"frame_{k:04d}_left.png", an_image(2 * k))
        write_image(folder / f"frame_{k:04d}_right.png", an_image(2 * k + 1))
        disparity_px = a_disparity(k)
        np.savez(
            folder / f"frame_{k:04d}_gt.npz",
            disp=np.nan_to_num(disparity_px * 64).astype(np.uint16),
            vis=np.packbits(disparity_px > 3, axis=1),
            nonspecular=np.packbits(disparity_px < 8, axis=1),
        )
    calib = {"fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 7.5, "baseline_m": 0.1, "fps": 25}
    write_lines(folder / "calib.json", json.dumps({**calib, "width": WIDTH, "height": HEIGHT}))
    write_lines(folder / "poses.txt", *(words(pose.matrix[:3]) for pose in some_poses(count)))
    return folder


def kitti_sequence(root: Path, cameras: tuple[int, ...] = (0, 1, 2, 3), count: int = 3) -> Path:
    folder = root / "sequences" / "00"
    for camera in cameras:
        for k in range(count):
            write_image(folder / f"image_{camera}" / f"{k:06d}.png", an_image(10 * camera + k))
    projections = (
        f"P{camera}: {words([20, 0, 11, 20 * offset_m, 0, 20, 7, 0, 0, 0, 1, 0])}"
        for camera, offset_m in enumerate((0.0, -0.54, 0.06, -0.47))
    )
    write_lines(folder / "calib.txt", *projections)
    write_lines(folder / "times.txt", *(f"{0.1 * k:.6e}" for k in range(count)))
    matrices = (words(pose.matrix[:3]) for pose in some_poses(count))
    write_lines(root / "poses" / "00.txt", *matrices)
    return folder


def kitti_pair(root: Path, year: int) -> Path:
    split = root / "training"
    left, right = ("image_0", "image_1") if year == 2012 else ("image_2", "image_3")
    write_image(split / left / "000046_10.png", an_image(1))
    write_image(split / right / "000046_10.png", an_image(2))
    suffix = "" if year == 2012 else "_0"
    disparity_px = a_disparity()
    stored = np.nan_to_num(disparity_px * 256).astype(np.uint16)
    write_image(split / f"disp_occ{suffix}" / "000046_10.png", stored)
    stored[disparity_px > 5] = 0
    write_image(split / f"disp_noc{suffix}" / "000046_10.png", stored)
    calib, label, first = (
        ("calib", "P{}:", 0) if year == 2012 else ("calib_cam_to_cam", "P_rect_0{}:", 2)
    )
    write_lines(
        split / calib / "000046.txt",
        "calib_time: 09-Jan-2012 13:57:47",
        f"{label.format(first)} {words([20, 0, 11, 1.2, 0, 20, 7, 0, 0, 0, 1, 0])}",
        f"{label.format(first + 1)} {words([20, 0, 11.5, -9.6, 0, 20, 7, 0, 0, 0, 1, 0])}",
    )
    return split / "000046"


def write_pfm_by_hand(path: Path, values: Plane, order: str = "<") -> None:
    """Bottom row first; a negative scale says little-endian; unknown is +inf."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scale = "-1.0" if order == "<" else "1.0"
    rows = np.where(np.isnan(values), np.inf, values)[::-1].astype(f"{order}f4")
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n"
    path.write_bytes(header.encode() + rows.tobytes())


def sceneflow_sequence(root: Path, count: int = 3) -> Path:
    rest = Path("TRAIN") / "A" / "0000"
    folder = root / "frames_finalpass" / rest
    blocks = []
    # Blender's camera looks along -z with y up: its columns y and z are the negatives of OpenCV's.
    blender_from_opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    for k, world_from_left in enumerate(some_poses(count), start=6):
        write_image(folder / "left" / f"{k:04d}.png", an_image(k))
        write_image(folder / "right" / f"{k:04d}.png", an_image(-k % 100))
        write_pfm_by_hand(root / "disparity" / rest / "left" / f"{k:04d}.pfm", a_disparity(k))
        world_from_right = world_from_left @ Pose(np.eye(3), np.array([0.065, 0, 0]))
        left, right = (
            words(pose.matrix @ blender_from_opencv) for pose in (world_from_left, world_from_right)
        )
        blocks += [f"Frame {k}", f"L {left}", f"R {right}", ""]
    write_lines(root / "camera_data" / rest / "camera_data.txt", *blocks)
    return folder


def tartanair_trajectory(root: Path, version: int, count: int = 3) -> Path:
    folder = root / "office" / ("Easy" if version == 1 else "Data_easy") / "P001"
    left, right = ("left", "right") if version == 1 else ("lcam_front", "rcam_front")
    lines = []
    # A vector (forward, right, down) of north-east-down is (right, down, forward) in OpenCV.
    ned_from_opencv = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])
    for k, pose in enumerate(some_poses(count)):
        write_image(folder / f"image_{left}" / f"{k:06d}_{left}.png", an_image(k))
        write_image(folder / f"image_{right}" / f"{k:06d}_{right}.png", an_image(50 + k))
        depth_m = (80 / a_disparity(k)).astype(np.float32)
        depth = folder / f"depth_{left}" / f"{k:06d}_{left}_depth"
        if version == 1:
            depth.parent.mkdir(parents=True, exist_ok=True)
            np.save(depth.with_suffix(".npy"), depth_m)
        else:
            bytes_bgra = depth_m.view(np.uint8).reshape(HEIGHT, WIDTH, 4)
            depth.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(depth.with_suffix(".png")), bytes_bgra)
        rotation = ned_from_opencv @ pose.rotation @ ned_from_opencv.T
        position = ned_from_opencv @ pose.translation_m
        lines.append(f"{words(position)} {words(xyzw_of(rotation))}")
    write_lines(folder / f"pose_{left}.txt", *lines)
    return folder


EUROC_START_NS = 1403636579763555584  # of MH_01: needs all 64 bits
EUROC_STEP_NS = 50_000_000
EUROC_LEFT_IN_BODY = Pose(rotation_about((0, 0, 1), 1.5), np.array([-0.02, -0.06, 0.01]))


def euroc_recording(root: Path, count: int = 4) -> Path:
    """Body poses lie halfway between the images, so that every pose must be interpolated."""
    folder = root / "MH_01_easy"
    right_in_body = EUROC_LEFT_IN_BODY @ Pose(
        rotation_about((1, 2, 3), 0.02), np.array([0.11, 0, 0])
    )
    times_ns = [EUROC_START_NS + k * EUROC_STEP_NS for k in range(count)]
    for camera, body_from_camera in (("cam0", EUROC_LEFT_IN_BODY), ("cam1", right_in_body)):
        for k, time_ns in enumerate(times_ns):
            image = an_image(k + 10 * (camera == "cam1"))[..., 0]
            write_image(folder / "mav0" / camera / "data" / f"{time_ns}.png", image)
        rows = np.array2string(
            body_from_camera.matrix.ravel(), separator=", ", max_line_width=60, precision=15
        )
        write_lines(
            folder / "mav0" / camera / "sensor.yaml",
            "sensor_type: camera",
            "T_BS:",
            "  cols: 4",
            "  rows: 4",
            f"  data: {rows}",
            "rate_hz: 20",
            f"resolution: [{WIDTH}, {HEIGHT}]",
            "camera_model: pinhole",
            "intrinsics: [20.5, 20.6, 11.7, 7.4] #fu, fv, cu, cv",
            "distortion_model: radial-tangential",
            "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]",
        )
        write_lines(
            folder / "mav0" / camera / "data.csv",
            "#timestamp [ns],filename",
            *(f"{time_ns},{time_ns}.png" for time_ns in times_ns),
        )
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], ..."]
    for k, pose in enumerate(some_poses(count)):
        x, y, z, w = xyzw_of(pose.rotation)
        numbers = [*pose.translation_m, w, x, y, z, 0, 0, 0, 0, 0, 0, 0, 0, 0]
        time_ns = times_ns[k] + EUROC_STEP_NS // 2
        lines.append(f"{time_ns},{','.join(f'{number:.12g}' for number in numbers)}")
    write_lines(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", *lines)
    return folder


def middlebury_scene(root: Path, truth: str = "disp0.pfm") -> Path:
    folder = root / "Motorcycle-perfect"
    write_image(folder / "im0.png", an_image(1))
    write_image(folder / "im1.png", an_image(2))
    write_lines(
        folder / "calib.txt",
        "cam0=[20.5 0 11.25; 0 20.5 7.5; 0 0 1]",
        "cam1=[20.5 0 13.75; 0 20.5 7.5; 0 0 1]",
        "doffs=2.5",
        "baseline=193.001",
        f"width={WIDTH}",
        f"height={HEIGHT}",
        "ndisp=70",
    )
    write_pfm_by_hand(folder / truth, a_disparity())
    return folder


def eth3d_scene(root: Path) -> Path:
    scene = middlebury_scene(root / "two_view_training", truth="unused.pfm")
    (scene / "unused.pfm").unlink()
    for name in ("cameras.txt", "images.txt"):
        write_lines(scene / name, "# COLMAP's")
    truth = root / "two_view_training_gt" / scene.name
    write_pfm_by_hand(truth / "disp0GT.pfm", a_disparity())
    mask = np.where(a_disparity() > 5, 128, 255).astype(np.uint8)
    write_image(truth / "mask0nocc.png", mask)
    return scene


TREES: dict[str, Callable[[Path], Path]] = {
    "vergence": vergence_sequence,
    "kitti": kitti_sequence,
    "kitti2012": lambda root: kitti_pair(root, 2012),
    "kitti2015": lambda root: kitti_pair(root, 2015),
    "sceneflow": sceneflow_sequence,
    "tartanair": lambda root: tartanair_trajectory(root, 1),
    "euroc": euroc_recording,
    "middlebury": middlebury_scene,
    "eth3d": eth3d_scene,
}
