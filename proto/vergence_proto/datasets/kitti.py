"""KITTI odometry: ``kitti:ROOT/sequences/00``.

::

    ROOT/sequences/00/image_2 image_3       colour left and right, rectified (or image_0, image_1)
    ROOT/sequences/00/calib.txt             P0: to P3:, each a 3x4 projection
    ROOT/sequences/00/times.txt             seconds, one per line
    ROOT/poses/00.txt                       sequences 00 to 10: world_from_cam0, 3x4 per line

The files state poses of the first grey camera. A colour camera is offset from it by K^-1 P[:, 3],
which is composed into its poses. There is no dense truth.
"""

from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_text
from vergence_proto.datasets.images import read_image
from vergence_proto.datasets.poses import read_matrix_poses
from vergence_proto.datasets.source import FrameFiles, StereoSource, nominal_ns, rectified_rig
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import StereoRig

_FPS = 10.0
_COLOUR = (2, 3)
_GREY = (0, 1)


def find(root: Path) -> list[Path]:
    """List every sequence in or under ``root``."""
    return sorted(
        path.parent
        for path in root.rglob("calib.txt")
        if (path.parent / "image_0").is_dir() or (path.parent / "image_2").is_dir()
    )


def open_path(path: Path) -> StereoSource:
    """Open one sequence; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    left, right = _COLOUR if (path / f"image_{_COLOUR[0]}").is_dir() else _GREY
    projections = read_projections(path / "calib.txt", "P{}:", (left, right))
    names = sorted(file.name for file in (path / f"image_{left}").glob("*.png"))
    if not names:
        raise DatasetError(f"{path}: expected PNG images in image_{_COLOUR[0]} or image_{_GREY[0]}")
    times_ns = _times_ns(path / "times.txt", len(names))
    trajectory = path.parent.parent / "poses" / f"{path.name}.txt"
    left_from_cam0 = Pose(np.eye(3), _offset_m(projections[0]))
    poses: list[Pose | None] = [None] * len(names)
    if trajectory.exists():
        poses = [each @ left_from_cam0.inverse() for each in read_matrix_poses(trajectory)]
    if len(poses) != len(names):
        raise DatasetError(f"{trajectory}: expected {len(names)} poses, got {len(poses)}")
    files = [
        FrameFiles(path / f"image_{left}" / name, path / f"image_{right}" / name, time_ns, pose)
        for name, time_ns, pose in zip(names, times_ns, poses, strict=True)
    ]
    height, width = read_image(files[0].left).shape[:2]
    rig = rig_from_projections(path / "calib.txt", projections, (width, height))
    return StereoSource(path.name, rig, _FPS, files)


def read_projections(path: Path, label: str, cameras: tuple[int, int]) -> tuple[Matrix, Matrix]:
    """Read two 3x4 projections from the lines that start with ``label`` and the camera's number.

    Raises DatasetError: the file or a line is missing, a line does not have 12 numbers, or they
    are no projection.
    """
    lines = dict(
        line.split(maxsplit=1)
        for line in read_text(path, "KITTI's camera projections").splitlines()
        if len(line.split(maxsplit=1)) == 2
    )
    found = []
    for camera in cameras:
        name = label.format(camera)
        if name not in lines:
            raise DatasetError(f"{path}: expected a line {name} with 12 numbers, found none")
        projection = np.reshape(numbers(lines[name], 12, f"{path}, {name}"), (3, 4))
        if not (projection[0, 0] > 0 and np.linalg.det(projection[:, :3]) > 0):
            raise DatasetError(f"{path}, {name}: expected K [I | t], got {projection.tolist()}")
        found.append(projection)
    return found[0], found[1]


def rig_from_projections(
    origin: Path, projections: tuple[Matrix, Matrix], size: tuple[int, int]
) -> StereoRig:
    """Make a rectified rig from two KITTI projections; ``size`` is (width, height).

    Raises DatasetError: the right camera is not to the right of the left one.
    """
    left, right = projections
    return rectified_rig(
        origin,
        size,
        fx=left[0, 0],
        fy=left[1, 1],
        cx=left[0, 2],
        cy=left[1, 2],
        cx_right=right[0, 2],
        baseline_m=_offset_m(left)[0] - _offset_m(right)[0],
    )


def _offset_m(projection: Matrix) -> Matrix:
    """Return cam0's origin in the coordinates of the camera of P = K [I | t]: t = K^-1 P[:, 3]."""
    return np.linalg.solve(projection[:, :3], projection[:, 3]).astype(np.float64)


def _times_ns(path: Path, count: int) -> list[int]:
    if not path.exists():
        return [nominal_ns(index, _FPS) for index in range(count)]
    times_s = numbers(read_text(path, "seconds, one per line"), count, str(path))
    return [round(time_s * 1e9) for time_s in times_s]
