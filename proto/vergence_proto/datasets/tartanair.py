"""TartanAir: version 1, ``tartanair:ENV/Easy/P001``, and 2, ``tartanair:ENV/Data_easy/P000``.

::

    1  image_left image_right/%06d_{left,right}.png       pose_left.txt
       depth_left/%06d_left_depth.npy                     640x480
    2  image_lcam_front image_rcam_front/%06d_{l,r}cam_front.png  pose_lcam_front.txt
       depth_lcam_front/%06d_lcam_front_depth.png         640x640, float32 in the four bytes of RGBA

Each line of poses is "tx ty tz qx qy qz qw", camera to world, with north-east-down axes for both.
The focal length is 320 px, the centre is at half the size, the baseline is 0.25 m. The data set
states no times. Of a trajectory only some frames may be there: each has the pose of its number.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, existing, numbers, read_lines
from vergence_proto.datasets.images import read_stored
from vergence_proto.datasets.listing import (
    found,
    image_beside,
    images,
    notes_on_poses,
    rows_of_frames,
)
from vergence_proto.datasets.packings import offsets_from_depth, read_npy, size_of
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
    return sorted({path.parent for version in _VERSIONS for path in found(root, version.poses)})


def open_path(path: Path) -> StereoSource:
    """Open one trajectory; all poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    version = next((each for each in _VERSIONS if (path / each.poses).exists()), None)
    if version is None:
        raise DatasetError(f"{path}: expected {' or '.join(each.poses for each in _VERSIONS)}")
    lefts = images(path / f"image_{version.left}", rf"\d+_{version.left}")
    if not lefts:
        raise DatasetError(f"{path / f'image_{version.left}'}: expected images, found none")
    digits = [left.stem.removesuffix(f"_{version.left}") for left in lefts]
    trajectory = path / version.poses
    poses = rows_of_frames(_read_poses(trajectory), [int(each) for each in digits])
    width, height = size_of(*lefts)
    rig = rectified_rig(
        path, (width, height), fx=_FX, cx=width / 2, cy=height / 2, baseline_m=_BASELINE_M
    )
    files = []
    for left, number, world_from_left in zip(lefts, digits, poses, strict=True):
        depth = path / f"depth_{version.left}" / f"{number}{version.depth}"
        files.append(
            FrameFiles(
                left,
                image_beside(left, path / f"image_{version.right}", f"{number}_{version.right}"),
                nominal_ns(int(number), None),
                world_from_left,
                partial(_truth, depth) if depth.is_file() else None,
            )
        )
    return StereoSource(path.name, rig, None, files, notes_on_poses(trajectory, poses))


def _read_poses(path: Path) -> list[Pose | None]:
    """Read world_from_left of each line; None where tracking was lost (NaN)."""
    lines = read_lines(path, "tx ty tz qx qy qz qw per line")
    poses = []
    for number, line in enumerate(lines, start=1):
        origin = f"{path}, line {number}"
        values = np.array(numbers(line, 7, origin))
        world_from_left = None
        if np.isfinite(values).all():
            world_from_left = Axes.NED.to_opencv(
                Pose.from_xyzw(checked_orientation(values[3:], origin), values[:3])
            )
        poses.append(world_from_left)
    return poses


def _truth(path: Path) -> Truth:
    return Truth(offsets_from_depth(_read_depth(path), _FX * _BASELINE_M))


def _read_depth(path: Path) -> Plane:
    existing(path, "depth in metres")
    if path.suffix != ".png":
        return read_npy(path, "depth").astype(np.float32)
    stored = read_stored(path)
    if stored.dtype != np.uint8 or stored.ndim != 3 or stored.shape[2] != 4:
        raise DatasetError(f"{path}: expected depth as an RGBA PNG, got {list(stored.shape)}")
    return np.ascontiguousarray(stored).view("<f4")[..., 0].astype(np.float32)
