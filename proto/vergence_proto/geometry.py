"""Poses, axis conventions, and the two-view geometry of a rectified rig.

Names say both frames: ``a_from_b`` maps b-coordinates to a, and in a product the inner names touch:
``curr_from_prev = curr_from_world @ world_from_prev``. Inside the project every camera frame has
OpenCV axes (x right, y down, z forward), every length is in metres, every disparity in pixels.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform, float64. Variables that hold one are named ``a_from_b``."""

    rotation: Matrix  # [3, 3], det +1
    translation_m: Matrix  # [3]

    @classmethod
    def identity(cls) -> Self:
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Matrix) -> Self:
        """From [3, 4] or [4, 4] row-major, rotation left of translation."""
        matrix = np.asarray(matrix, np.float64)
        return cls(matrix[:3, :3].copy(), matrix[:3, 3].copy())

    @classmethod
    def from_xyzw(cls, orientation_xyzw: Matrix, translation_m: Matrix) -> Self:
        """From a quaternion (Hamilton, scalar last, any non-zero length) and a translation [3]."""
        x, y, z, w = np.asarray(orientation_xyzw, np.float64) / np.linalg.norm(orientation_xyzw)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(rotation, np.array(translation_m, np.float64))

    @property
    def orientation_xyzw(self) -> Matrix:
        """The unit quaternion [4], scalar last and non-negative."""
        r = self.rotation
        # The four squared components (times four) from the diagonal; starting from the largest
        # one keeps the division well conditioned (Shepperd 1978).
        squares = 1 + np.array(
            [
                r[0, 0] - r[1, 1] - r[2, 2],
                r[1, 1] - r[0, 0] - r[2, 2],
                r[2, 2] - r[0, 0] - r[1, 1],
                r[0, 0] + r[1, 1] + r[2, 2],
            ]
        )
        xy, xz, yz = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
        xw, yw, zw = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        products = np.array([[0, xy, xz, xw], [xy, 0, yz, yw], [xz, yz, 0, zw], [xw, yw, zw, 0]])
        largest = int(np.argmax(squares))
        quaternion: Matrix = products[largest]
        quaternion[largest] = squares[largest]
        quaternion /= np.linalg.norm(quaternion)
        return -quaternion if quaternion[3] < 0 else quaternion

    @property
    def matrix(self) -> Matrix:
        """Homogeneous [4, 4]."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation_m
        return matrix

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(
            self.rotation @ other.rotation,
            self.rotation @ other.translation_m + self.translation_m,
        )

    def inverse(self) -> "Pose":
        back = self.rotation.T
        return Pose(back, -back @ self.translation_m)

    def apply(self, points_b: Matrix) -> Matrix:
        """Map points [..., 3] from b-coordinates to a-coordinates."""
        return points_b @ self.rotation.T + self.translation_m


class Axes(Enum):
    """The axis convention in which a client states its poses, world and camera alike.

    The value is the matrix that takes a vector of that convention to OpenCV axes. All are
    signed permutations; Unity's has determinant -1, because Unity is left-handed.
    """

    OPENCV = ((1, 0, 0), (0, 1, 0), (0, 0, 1))  # x right, y down, z forward
    OPENXR = ((1, 0, 0), (0, -1, 0), (0, 0, -1))  # x right, y up, z back
    UNITY = ((1, 0, 0), (0, -1, 0), (0, 0, 1))  # x right, y up, z forward
    NED = ((0, 1, 0), (0, 0, 1), (1, 0, 0))  # x forward, y right, z down

    def to_opencv(self, pose: Pose) -> Pose:
        """The same motion, stated in OpenCV axes."""
        opencv_from_self = np.array(self.value, np.float64)
        return Pose(
            opencv_from_self @ pose.rotation @ opencv_from_self.T,
            opencv_from_self @ pose.translation_m,
        )

    def from_opencv(self, pose: Pose) -> Pose:
        """The inverse of :meth:`to_opencv`."""
        self_from_opencv = np.array(self.value, np.float64).T
        return Pose(
            self_from_opencv @ pose.rotation @ self_from_opencv.T,
            self_from_opencv @ pose.translation_m,
        )


@dataclass(frozen=True, slots=True)
class RectifiedRig:
    """A rectified pair: rows correspond, both cameras share focal lengths and cy."""

    width: int
    height: int
    fx: float  # pixels
    fy: float
    cx_left: float  # pixels; pixel centres sit at integer coordinates
    cx_right: float
    cy: float
    baseline_m: float

    @property
    def offset_of_zero_disparity_px(self) -> float:
        """u_left - u_right of a point at infinity; Middlebury's ``doffs`` is its negative."""
        return self.cx_left - self.cx_right

    def depth_from_disparity(self, disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        """Z = fx * baseline / d, metres along the optical axis; NaN where d is not positive."""
        positive = disparity_px > 0
        safe = np.where(positive, disparity_px, np.float32(1))
        depth = np.float32(self.fx * self.baseline_m) / safe
        return np.where(positive, depth, np.float32(np.nan))

    def disparity_from_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """D = fx * baseline / Z, pixels; NaN where the depth is not positive."""
        return self.depth_from_disparity(depth_m)  # the map is its own inverse

    @property
    def xyzw_from_uvd(self) -> Matrix:
        """Q [4, 4]: (u, v, u_left - u_right, 1) to homogeneous left-camera metres."""
        return np.array(
            [
                [1, 0, 0, -self.cx_left],
                [0, self.fx / self.fy, 0, -self.cy * self.fx / self.fy],
                [0, 0, 0, self.fx],
                [0, 0, 1 / self.baseline_m, -self.offset_of_zero_disparity_px / self.baseline_m],
            ]
        )


def uvd_curr_from_prev(
    rig: RectifiedRig, curr_from_prev: Pose, prev_rig: RectifiedRig | None = None
) -> NDArray[np.float32]:
    """How a rigid motion of the camera moves pixels and disparities: float32 [4, 4].

    Takes homogeneous (u, v, u_left - u_right, 1) of the previous frame to the current one:
    ``Q^-1 [RT]_{curr<-prev} Q``. Stereo Matching in Time (WACV 2024, section 3.2) prints the
    product the other way round, which does not fit the Q it defines. Composed in float64.
    """
    uvd_from_xyzw = np.linalg.inv(rig.xyzw_from_uvd)
    transform = uvd_from_xyzw @ curr_from_prev.matrix @ (prev_rig or rig).xyzw_from_uvd
    return transform.astype(np.float32)
