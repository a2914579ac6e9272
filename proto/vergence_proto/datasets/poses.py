"""Trajectories: read and checked, and interpolated to the times of the images."""

import bisect
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.errors import BadPose
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.opencv import cv2

_UNIT_TOLERANCE = 1e-2
# Over a longer gap, a head or a drone may not move in a straight line.
_LONGEST_GAP_NS = 100_000_000


def read_matrix_poses(path: Path) -> list[Pose | None]:
    """Read ``world_from_camera``, 12 numbers per line, row-major (or 16, with the row 0 0 0 1).

    A pose that its tracker lost (NaN) is None.
    Raises DatasetError: the file is missing, or a line is no rigid transform.
    """
    lines = read_lines(path, "one 3x4 camera-to-world matrix per line")
    poses = []
    for number, line in enumerate(lines, start=1):
        origin = f"{path}, line {number}"
        row = numbers(line, None, origin)
        if len(row) not in (12, 16):
            raise DatasetError(f"{origin}: expected 12 numbers, got {len(row)}")
        poses.append(tracked_pose(np.reshape(row, (-1, 4)), origin))
    return poses


def tracked_pose(matrix: Matrix, origin: str) -> Pose | None:
    """Return the pose of a [3, 4] or [4, 4] matrix, None if a number is not finite.

    Trackers write NaN or infinity for a pose that they lost.
    Raises DatasetError: the matrix is no rigid transform.
    """
    return checked_pose(matrix, origin) if np.isfinite(matrix).all() else None


def checked_pose(matrix: Matrix, origin: str) -> Pose:
    """Return the pose of a [3, 4] or [4, 4] matrix.

    Raises DatasetError: the matrix is no rigid transform.
    """
    try:
        return Pose.from_matrix(matrix)
    except BadPose as error:
        raise DatasetError(f"{origin}: {error}") from None


def checked_orientation(xyzw: Matrix, origin: str) -> Matrix:
    """Return the quaternion. Raises DatasetError: its length is not 1 within rounding."""
    length = float(np.linalg.norm(xyzw))
    if not abs(length - 1) <= _UNIT_TOLERANCE:  # NaN fails here too
        raise DatasetError(f"{origin}: expected a unit quaternion, got length {length:.6g}")
    return xyzw


def interpolated(times_ns: Sequence[int], poses: Sequence[Pose], time_ns: int) -> Pose | None:
    """Interpolate the pose at ``time_ns``; None before, after or in a gap of the trajectory.

    ``times_ns`` ascends. Rotation is interpolated by slerp, position linearly.
    """
    after = bisect.bisect_left(times_ns, time_ns)
    if after < len(times_ns) and times_ns[after] == time_ns:
        return poses[after]
    if after in (0, len(times_ns)):
        return None
    start_ns, end_ns = times_ns[after - 1], times_ns[after]
    if end_ns - start_ns > _LONGEST_GAP_NS:
        return None
    start, end = poses[after - 1], poses[after]
    share = (time_ns - start_ns) / (end_ns - start_ns)
    turn, _ = cv2.Rodrigues(start.rotation.T @ end.rotation)  # to axis times angle
    part, _ = cv2.Rodrigues(turn * share)
    return Pose(
        start.rotation @ np.asarray(part, np.float64),
        start.translation_m + share * (end.translation_m - start.translation_m),
    )
