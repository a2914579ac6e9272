"""KITTI odometry: ``kitti:ROOT/sequences/00``.

::

    ROOT/sequences/00/image_2 image_3       colour left and right, rectified (or image_0, image_1)
    ROOT/sequences/00/calib.txt             P0: to P3:, each a 3x4 projection
    ROOT/sequences/00/times.txt             seconds, one per line
    ROOT/poses/00.txt                       sequences 00 to 10: world_from_cam0, 3x4 per line

The files state poses of the first grey camera. A colour camera is offset from it by K^-1 P[:, 3],
which is composed into its poses. There is no dense truth. Of a sequence only some frames may be
there: each has the pose and the time of its number.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.datasets.listing import (
    found,
    image_beside,
    images,
    notes_on_poses,
    number_in,
    rows_of_frames,
)
from vergence_proto.datasets.packings import size_of
from vergence_proto.datasets.poses import read_matrix_poses
from vergence_proto.datasets.source import FrameFiles, StereoSource, nominal_ns, rectified_rig
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import StereoRig

_FPS = 10.0
_COLOUR = (2, 3)
_GREY = (0, 1)


def find(root: Path) -> list[Path]:
    """List every sequence in or under ``root``."""
    return [
        path.parent
        for path in found(root, "calib.txt")
        if (path.parent / "image_0").is_dir() or (path.parent / "image_2").is_dir()
    ]


def open_path(path: Path) -> StereoSource:
    """Open one sequence; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    left, right = _COLOUR if (path / f"image_{_COLOUR[0]}").is_dir() else _GREY
    projections = read_projections(path / "calib.txt", "P{}:", (left, right))
    lefts = images(path / f"image_{left}", r"\d+")
    if not lefts:
        raise DatasetError(f"{path}: expected PNG images in image_{_COLOUR[0]} or image_{_GREY[0]}")
    numbers_of = [number_in(each) for each in lefts]
    times_ns = _times_ns(path / "times.txt", numbers_of)
    trajectory = path.parent.parent / "poses" / f"{path.name}.txt"
    left_from_cam0 = Pose(np.eye(3), _offset_m(projections[0]))
    poses: list[Pose | None] = [None] * len(lefts)
    notes: tuple[str, ...] = ()
    if trajectory.exists():
        read = rows_of_frames(read_matrix_poses(trajectory), numbers_of)
        poses = [None if each is None else each @ left_from_cam0.inverse() for each in read]
        notes = notes_on_poses(trajectory, poses)
    files = [
        FrameFiles(
            each, image_beside(each, path / f"image_{right}", each.stem), time_ns, world_from_left
        )
        for each, time_ns, world_from_left in zip(lefts, times_ns, poses, strict=True)
    ]
    rig = rig_from_projections(path / "calib.txt", projections, size_of(*lefts))
    return StereoSource(path.name, rig, _FPS, files, notes)


def read_projections(path: Path, label: str, cameras: tuple[int, int]) -> tuple[Matrix, Matrix]:
    """Read two 3x4 projections from the lines that start with ``label`` and the camera's number.

    Raises DatasetError: the file or a line is missing, a line does not have 12 numbers, or they
    are no projection.
    """
    lines = dict(
        words
        for line in read_lines(path, "KITTI's camera projections")
        if len(words := line.split(maxsplit=1)) == 2
    )
    projections = []
    for camera in cameras:
        name = label.format(camera)
        if name not in lines:
            raise DatasetError(f"{path}: expected a line {name} with 12 numbers, found none")
        projection = np.reshape(numbers(lines[name], 12, f"{path}, {name}"), (3, 4))
        if not (projection[0, 0] > 0 and np.linalg.det(projection[:, :3]) > 0):
            raise DatasetError(f"{path}, {name}: expected K [I | t], got {projection.tolist()}")
        projections.append(projection)
    return projections[0], projections[1]


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


def _times_ns(path: Path, frames: Sequence[int]) -> list[int]:
    if not path.exists():
        return [nominal_ns(number, _FPS) for number in frames]
    lines = read_lines(path, "seconds, one per line")
    times_s = [numbers(line, 1, f"{path}, line {n}")[0] for n, line in enumerate(lines, start=1)]
    found_s = rows_of_frames(times_s, frames)
    return [
        nominal_ns(number, _FPS) if time_s is None else round(time_s * 1e9)
        for number, time_s in zip(frames, found_s, strict=True)
    ]
