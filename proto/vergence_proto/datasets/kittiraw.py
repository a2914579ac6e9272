"""KITTI raw: ``kittiraw:ROOT/2011_09_26/2011_09_26_drive_0001_sync``, rectified and synchronised.

::

    DRIVE/image_02 image_03/data/%010d.png      colour left and right (or image_00, image_01)
    DRIVE/image_02/timestamps.txt               2011-09-26 13:02:25.964389445, one per frame
    DRIVE/oxts/data/%010d.txt                   lat lon alt roll pitch yaw ... of the GPS and IMU
    DRIVE/proj_depth/groundtruth/image_02/%010d.png    of the depth benchmark: metres x256, 0 none
    calib_cam_to_cam.txt calib_velo_to_cam.txt calib_imu_to_velo.txt     in the drive's own folder
                                                                         or the date's

The world is east, north, up, with its origin at the first position of the drive.
"""

import datetime
import math
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.datasets.kitti import rig_from_projections
from vergence_proto.datasets.listing import (
    found,
    image_beside,
    images,
    number_in,
    read_keyed,
)
from vergence_proto.datasets.packings import nominal_rig, offsets_from_depth, read_grey, size_of
from vergence_proto.datasets.poses import checked_pose
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, nominal_ns
from vergence_proto.geometry import Matrix, Pose

_FPS = 10.0
_COLOUR = ("02", "03")
_GREY = ("00", "01")
_EARTH_RADIUS_M = 6378137.0
_DEPTH_STEPS_PER_M = 256.0
_OXTS_FIELDS = 30


def find(root: Path) -> list[Path]:
    """List every drive in or under ``root``."""
    folders = (found(root, f"image_{left}/data") for left in (_COLOUR[0], _GREY[0]))
    return sorted({folder.parents[1] for each in folders for folder in each if folder.is_dir()})


def open_path(path: Path) -> StereoSource:
    """Open one drive; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    left, right = _COLOUR if (path / f"image_{_COLOUR[0]}").is_dir() else _GREY
    lefts = images(path / f"image_{left}" / "data", r"\d+")
    if not lefts:
        raise DatasetError(
            f"{path}: expected images in image_{_COLOUR[0]}/data or image_{_GREY[0]}/data"
        )
    size = size_of(*lefts)
    calib = next(
        (each for each in (path, path.parent) if (each / "calib_cam_to_cam.txt").is_file()), None
    )
    cameras = None if calib is None else _read_cameras(calib / "calib_cam_to_cam.txt", left, right)
    poses: dict[int, Pose] = {}
    rig, px_m = nominal_rig(path, size), None
    if calib is not None and cameras is not None:
        rig = rig_from_projections(calib / "calib_cam_to_cam.txt", cameras[:2], size)
        px_m = cameras[0][0, 0] * (_offset_m(cameras[0])[0] - _offset_m(cameras[1])[0])
        imu_from_left = _imu_from_left(calib, cameras)
        if imu_from_left is not None:
            poses = _read_poses(path / "oxts" / "data", imu_from_left)
    times_ns = _read_times(path / f"image_{left}" / "timestamps.txt")
    depth = path / "proj_depth" / "groundtruth" / f"image_{left}"
    files = []
    for image in lefts:
        number, truth = number_in(image), depth / f"{image.stem}.png"
        files.append(
            FrameFiles(
                image,
                image_beside(image, path / f"image_{right}" / "data", image.stem),
                times_ns[number] if number < len(times_ns) else nominal_ns(number, _FPS),
                poses.get(number),
                partial(_truth, truth, px_m) if px_m and truth.is_file() else None,
            )
        )
    return StereoSource(path.name, rig, _FPS, files, metric=px_m is not None)


def _read_cameras(path: Path, left: str, right: str) -> tuple[Matrix, Matrix, Matrix]:
    """The two projections, and rect_from_cam0 [3, 3]."""
    wanted = {f"P_rect_{left}": 12, f"P_rect_{right}": 12, "R_rect_00": 9}
    read = read_keyed(path, "KITTI's cameras", **wanted)
    for key, count in wanted.items():
        if key not in read:
            raise DatasetError(f"{path}: expected a line {key}: with {count} numbers, found none")
    first, second = (np.reshape(read[f"P_rect_{each}"], (3, 4)) for each in (left, right))
    return first, second, np.reshape(read["R_rect_00"], (3, 3))


def _offset_m(projection: Matrix) -> Matrix:
    """Where the rectified cam0's origin is in the camera of P = K [I | t]."""
    return np.linalg.solve(projection[:, :3], projection[:, 3]).astype(np.float64)


def _imu_from_left(calib: Path, cameras: tuple[Matrix, Matrix, Matrix]) -> Pose | None:
    names = ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
    if not all((calib / name).is_file() for name in names):
        return None
    cam0_from_velo, velo_from_imu = (_read_transform(calib / name) for name in names)
    rect_from_cam0 = Pose(cameras[2], np.zeros(3))
    left_from_rect = Pose(np.eye(3), _offset_m(cameras[0]))
    return (left_from_rect @ rect_from_cam0 @ cam0_from_velo @ velo_from_imu).inverse()


def _read_transform(path: Path) -> Pose:
    read = read_keyed(path, "R: and T:", R=9, T=3)
    if "R" not in read or "T" not in read:
        raise DatasetError(f"{path}: expected lines R: and T:, got {', '.join(read) or 'none'}")
    matrix = np.column_stack([np.reshape(read["R"], (3, 3)), read["T"]])
    return checked_pose(matrix, str(path))


def _read_poses(folder: Path, imu_from_left: Pose) -> dict[int, Pose]:
    """Read world_from_left of each frame number."""
    fixes = {number_in(path): _read_fix(path) for path in found(folder, "*.txt")}
    if not fixes:
        return {}
    first = fixes[min(fixes)]
    scale = math.cos(math.radians(first[0]))
    origin_m = _mercator_m(first, scale)
    poses = {}
    for number, fix in fixes.items():
        roll, pitch, yaw = fix[3:6]
        rotation = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
        world_from_imu = Pose(rotation, _mercator_m(fix, scale) - origin_m)
        poses[number] = world_from_imu @ imu_from_left
    return poses


def _read_fix(path: Path) -> list[float]:
    words = " ".join(read_lines(path, "a GPS and IMU reading"))
    return numbers(words, _OXTS_FIELDS, str(path))


def _mercator_m(fix: list[float], scale: float) -> Matrix:
    latitude, longitude, altitude_m = fix[:3]
    north = math.log(math.tan(math.radians(90 + latitude) / 2))
    return np.array(
        [
            scale * _EARTH_RADIUS_M * math.radians(longitude),
            scale * _EARTH_RADIUS_M * north,
            altitude_m,
        ]
    )


def _about(axis: int, angle: float) -> Matrix:
    """A turn about x, y or z."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first] = rotation[second, second] = cos
    rotation[second, first], rotation[first, second] = sin, -sin
    return rotation


def _read_times(path: Path) -> list[int]:
    if not path.exists():
        return []
    times_ns = []
    for line in read_lines(path, "a date and time per line"):
        whole, _, fraction = line.partition(".")
        try:
            time = datetime.datetime.fromisoformat(whole).replace(tzinfo=datetime.UTC)
            nanoseconds = int(fraction.ljust(9, "0")[:9] or 0)
        except ValueError:
            raise DatasetError(f"{path}: expected a date and time, got {line!r}") from None
        times_ns.append(int(time.timestamp()) * 1_000_000_000 + nanoseconds)
    return times_ns


def _truth(path: Path, px_m: float) -> Truth:
    stored = read_grey(path)
    if stored.dtype != np.uint16:
        raise DatasetError(f"{path}: expected a 16-bit PNG (metres x256), got {stored.dtype}")
    return Truth(offsets_from_depth(stored / _DEPTH_STEPS_PER_M, px_m))
