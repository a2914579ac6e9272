"""Virtual KITTI 2: ``vkitti2:ROOT/Scene01/clone``.

::

    ROOT/Scene01/clone/frames/rgb/Camera_0 Camera_1/rgb_%05d.jpg     left and right
    ROOT/Scene01/clone/frames/depth/Camera_0/depth_%05d.png          16 bits, centimetres
    ROOT/Scene01/clone/intrinsic.txt      frame cameraID fx fy cx cy
    ROOT/Scene01/clone/extrinsic.txt      frame cameraID camera_from_world, 4x4

The archives may also lie beside one another, as ``vkitti_2.0.3_rgb``, ``..._depth`` and
``..._textgt``. A depth of 655.35 m is the sky and has no truth. The baseline is 0.532725 m.
"""

from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.listing import found, image_beside, images, number_in, read_rows
from vergence_proto.datasets.packings import nominal_rig, offsets_from_depth, read_grey, size_of
from vergence_proto.datasets.poses import tracked_pose
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Pose
from vergence_proto.types import StereoRig

_BASELINE_M = 0.532725
_OWN_SIZE = (1242, 375)
_OWN_INTRINSICS = (725.0087, 725.0087, 620.5, 187.0)
_STEPS_PER_M = 100.0
_SKY = 65535
_FPS = 10.0  # KITTI's


def find(root: Path) -> list[Path]:
    """List every variation of a scene in or under ``root``."""
    return [
        folder.parents[2]
        for folder in found(root, "Camera_0")
        if folder.parts[-3:-1] == ("frames", "rgb")
    ]


def open_path(path: Path) -> StereoSource:
    """Open one variation of a scene; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    rgb = path / "frames" / "rgb"
    lefts = images(rgb / "Camera_0", r"rgb_\d+")
    if not lefts:
        raise DatasetError(f"{rgb / 'Camera_0'}: expected images rgb_%05d.jpg, found none")
    text, depth = _archive(path, "textgt"), _archive(path, "depth") / "frames/depth/Camera_0"
    poses = _read_poses(text / "extrinsic.txt")
    rig, px_m = _read_rig(text / "intrinsic.txt", size_of(*lefts))
    files = []
    for index, left in enumerate(lefts):
        truth = depth / f"{left.stem.replace('rgb', 'depth')}.png"
        files.append(
            FrameFiles(
                left,
                image_beside(left, rgb / "Camera_1", left.stem),
                nominal_ns(index, _FPS),
                poses.get(number_in(left)),
                partial(_truth, truth, px_m) if truth.is_file() and px_m else None,
            )
        )
    name = f"{path.parent.name}_{path.name}"
    return StereoSource(name, rig, _FPS, files, metric=px_m is not None)


def _archive(path: Path, kind: str) -> Path:
    """The same scene in the archive of another kind of data, or the scene's own folder."""
    for index, part in enumerate(path.parts):
        if part.startswith("vkitti_") and part.endswith("_rgb"):
            beside = part.removesuffix("rgb") + kind
            return Path(*path.parts[:index], beside, *path.parts[index + 1 :])
    return path


def _read_poses(path: Path) -> dict[int, Pose]:
    """Read world_from_left of each frame number."""
    if not path.exists():
        return {}
    rows = read_rows(path, 18, "frame, cameraID and 16 numbers per line")
    poses = {
        int(row[0]): tracked_pose(np.reshape(row[2:], (4, 4)), f"{path}, frame {int(row[0])}")
        for row in rows
        if row[1] == 0
    }
    return {number: pose.inverse() for number, pose in poses.items() if pose is not None}


def _read_rig(path: Path, size: tuple[int, int]) -> tuple[StereoRig, float | None]:
    """The rig, and focal length times baseline, None where the rig is nominal."""
    if path.exists():
        rows = read_rows(path, 6, "frame, cameraID, fx, fy, cx, cy per line")
        lefts = [row[2:] for row in rows if row[1] == 0]
        if not lefts:
            raise DatasetError(f"{path}: expected lines with cameraID 0, found none")
        fx, fy, cx, cy = lefts[0]
    elif size == _OWN_SIZE:
        fx, fy, cx, cy = _OWN_INTRINSICS
    else:
        return nominal_rig(path, size), None
    rig = rectified_rig(path, size, fx=fx, fy=fy, cx=cx, cy=cy, baseline_m=_BASELINE_M)
    return rig, fx * _BASELINE_M


def _truth(path: Path, px_m: float) -> Truth:
    stored = read_grey(path)
    if stored.dtype != np.uint16:
        raise DatasetError(f"{path}: expected a 16-bit PNG of centimetres, got {stored.dtype}")
    depth_m = np.where(stored == _SKY, 0, stored / _STEPS_PER_M)
    return Truth(offsets_from_depth(depth_m, px_m))
