"""TartanAir: version 1, ``tartanair:ENV/Easy/P001``, and 2, ``tartanair:ENV/Data_easy/P000``.

::

    1  image_left image_right/%06d_{left,right}.png       pose_left.txt
       depth_left/%06d_left_depth.npy                     640x480
    2  image_lcam_front image_rcam_front/%06d_{l,r}cam_front.png  pose_lcam_front.txt
       depth_lcam_front/%06d_lcam_front_depth.png         640x640, float32 in the four bytes of RGBA

Each line of poses is "tx ty tz qx qy qz qw", camera to world, with north-east-down axes for both.
The focal length is 320 px, the centre is at half the size, the baseline is 0.25 m. The data set
states no times.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, existing, numbers, read_text
from vergence_proto.datasets.images import read_image, read_stored_png
from vergence_proto.datasets.poses import checked_orientation
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import Plane

_FX = 320.0
_BASELINE_M = 0.25


@dataclass(frozen=True, slots=True)
class _Version:
    left: str
    right: str
    depth: str  # a depth file's name after the number

    @property
    def poses(self) -> str:
        return f"pose_{self.left}.txt"


_VERSIONS = (
    _Version("left", "right", "_left_depth.npy"),
    _Version("lcam_front", "rcam_front", "_lcam_front_depth.png"),
)


def find(root: Path) -> list[Path]:
    """List every trajectory in or under ``root``."""
    return sorted({path.parent for version in _VERSIONS for path in root.rglob(version.poses)})


def open_path(path: Path) -> StereoSource:
    """Open one trajectory; all poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    version = next((each for each in _VERSIONS if (path / each.poses).exists()), None)
    if version is None:
        raise DatasetError(f"{path}: expected {' or '.join(each.poses for each in _VERSIONS)}")
    poses = _read_poses(path / version.poses)
    lefts = sorted((path / f"image_{version.left}").glob(f"*_{version.left}.png"))
    if not lefts or len(lefts) != len(poses):
        raise DatasetError(
            f"{path / version.poses}: expected a pose for each of {len(lefts)} images in "
            f"image_{version.left}, got {len(poses)}"
        )
    height, width = read_image(lefts[0]).shape[:2]
    rig = rectified_rig(
        path, (width, height), fx=_FX, cx=width / 2, cy=height / 2, baseline_m=_BASELINE_M
    )
    files = []
    for index, (left, world_from_left) in enumerate(zip(lefts, poses, strict=True)):
        number = left.name.removesuffix(f"_{version.left}.png")
        right = path / f"image_{version.right}" / f"{number}_{version.right}.png"
        depth = path / f"depth_{version.left}" / f"{number}{version.depth}"
        read_truth = partial(_truth, depth) if depth.parent.is_dir() else None
        files.append(FrameFiles(left, right, nominal_ns(index, None), world_from_left, read_truth))
    return StereoSource(path.name, rig, None, files)


def _read_poses(path: Path) -> list[Pose]:
    lines = read_text(path, "tx ty tz qx qy qz qw per line").splitlines()
    poses = []
    for number, line in enumerate((line for line in lines if line.strip()), start=1):
        origin = f"{path}, line {number}"
        values = np.array(numbers(line, 7, origin))
        world_from_left = Pose.from_xyzw(checked_orientation(values[3:], origin), values[:3])
        poses.append(Axes.NED.to_opencv(world_from_left))
    return poses


def _truth(path: Path) -> Truth:
    depth_m = _read_depth(path)
    offset_px = np.full(depth_m.shape, np.nan, np.float32)
    known = np.isfinite(depth_m) & (depth_m > 0)
    offset_px[known] = _FX * _BASELINE_M / depth_m[known]
    return Truth(offset_px)


def _read_depth(path: Path) -> Plane:
    existing(path, "depth in metres")
    if path.suffix == ".png":
        stored = read_stored_png(path)
        if stored.dtype != np.uint8 or stored.ndim != 3 or stored.shape[2] != 4:
            raise DatasetError(f"{path}: expected depth as an RGBA PNG, got {list(stored.shape)}")
        return np.ascontiguousarray(stored).view("<f4")[..., 0].astype(np.float32)
    try:
        depth_m = np.load(path)
    except (ValueError, EOFError, OSError) as error:
        raise DatasetError(f"{path}: expected a readable .npy: {error}") from None
    if depth_m.ndim != 2:
        raise DatasetError(f"{path}: expected depth [H, W], got {list(depth_m.shape)}")
    return np.asarray(depth_m, np.float32)
