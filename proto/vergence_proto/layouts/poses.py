"""Trajectory files: one 3x4 camera-to-world matrix a line."""

from pathlib import Path

import numpy as np

from vergence_proto.geometry import Matrix, Pose
from vergence_proto.layouts.files import LayoutError, numbers, read_text

# Files print six digits, and some rotations were multiplied together in float32.
_ORTHONORMAL_TOLERANCE = 1e-3


def read_matrix_poses(path: Path) -> list[Pose]:
    """Read ``world_from_camera``, 12 numbers a line, row-major.

    Raises LayoutError: missing, a line that is no rigid transform.
    """
    text = read_text(path, "one 3x4 camera-to-world matrix a line")
    lines = [line for line in text.splitlines() if line.strip()]
    return [
        checked_pose(
            np.reshape(numbers(line, 12, f"{path}, line {number}"), (3, 4)),
            f"{path}, line {number}",
        )
        for number, line in enumerate(lines, start=1)
    ]


def checked_pose(matrix: Matrix, origin: str) -> Pose:
    """The pose of a [3, 4] or [4, 4] matrix. Raises LayoutError: it is no rigid transform."""
    pose = Pose.from_matrix(matrix)
    error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    rigid = error <= _ORTHONORMAL_TOLERANCE and np.linalg.det(pose.rotation) > 0
    if not (rigid and np.isfinite(pose.translation_m).all()):
        raise LayoutError(
            f"{origin}: expected a rotation (orthonormal, determinant +1) and a finite "
            f"translation, got {np.asarray(matrix)[:3].tolist()}"
        )
    return pose
