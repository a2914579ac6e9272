"""Poses, axis conventions, and the two-view geometry of a rectified rig.

Names say both frames: ``a_from_b`` maps b-coordinates to a, and in a product the inner names touch:
``curr_from_prev = curr_from_world @ world_from_prev``. Inside the project every camera frame has
OpenCV axes (x right, y down, z forward), every length is in metres, every disparity in pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadCalibration, BadPose

Matrix = NDArray[np.float64]

# Rounding to float32 and a few multiplications change a rotation by much less than this.
_RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform ``p_a = rotation @ p_b + translation_m``, in float64.

    Variables that hold a pose are named ``a_from_b``: it maps b-coordinates to a-coordinates. The
    constructor takes lists too, and a translation [3, 1] as OpenCV returns it. It checks shapes and
    not that the rotation is one.

    Raises
    ------
    BadPose
        The rotation is not [3, 3] or the translation not [3], or they are no numbers.
    """

    rotation: Matrix
    """Float64 [3, 3], orthonormal, determinant +1."""
    translation_m: Matrix
    """Float64 [3], metres: the origin of b in a-coordinates."""

    def __post_init__(self) -> None:
        rotation = _float64(self.rotation, "a rotation [3, 3]")
        translation_m = _float64(self.translation_m, "a translation [3]")
        if translation_m.shape in ((3, 1), (1, 3)):
            translation_m = translation_m.ravel()
        if rotation.shape != (3, 3) or translation_m.shape != (3,):
            raise BadPose(
                "expected a rotation [3, 3] and a translation [3], got shapes "
                f"{list(rotation.shape)} and {list(translation_m.shape)}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", translation_m)

    @classmethod
    def identity(cls) -> Self:
        """Return the pose that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Matrix | Sequence[Sequence[float]]) -> Self:
        """Make a pose of a [3, 4] or [4, 4] row-major matrix, rotation left of translation.

        The input, an array or lists of rows, is converted to float64 and copied.

        Raises
        ------
        BadPose
            The matrix has another shape, a number is not finite, the last row is not 0 0 0 1, or
            the rotation is not orthonormal with determinant +1 (scaled, sheared, mirrored); each
            within 0.001.
        """
        values = _float64(matrix, "a [3, 4] or [4, 4] matrix")
        if values.shape not in ((3, 4), (4, 4)):
            raise BadPose(
                f"expected a [3, 4] or [4, 4] matrix, got shape {list(values.shape)}; "
                "put the rotation left of the translation, or make a pose of a quaternion by "
                "Pose.from_xyzw"
            )
        if not np.isfinite(values).all():
            raise BadPose(
                f"expected a pose of finite numbers, got {values.tolist()}; "
                "if tracking is lost, send the frame without a pose"
            )
        rotation, translation_m = values[:3, :3].copy(), values[:3, 3].copy()
        if len(values) == 4 and not np.abs(values[3] - (0, 0, 0, 1)).max() <= _RIGID_TOLERANCE:
            raise BadPose(
                f"expected 0 0 0 1 as the last row, got {values[3].tolist()}; "
                "a pose is row-major: a matrix of a graphics library may have to be transposed"
            )
        check_rotation(rotation)
        return cls(rotation, translation_m)

    @classmethod
    def from_xyzw(cls, orientation_xyzw: Matrix, translation_m: Matrix) -> Self:
        """Make a pose of a quaternion [4] and a translation [3] in metres.

        The quaternion is Hamilton's, scalar last, of any non-zero length.

        Raises
        ------
        BadPose
            A shape is another one, a number is not finite, or the quaternion is zero.
        """
        quaternion = _vector(orientation_xyzw, 4, "a quaternion x y z w")
        translation_m = _vector(translation_m, 3, "a translation x y z")
        if not np.any(quaternion):
            raise BadPose("expected a quaternion x y z w of non-zero length, got zeros")
        x, y, z, w = quaternion / np.linalg.norm(quaternion)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(rotation, translation_m)

    @property
    def orientation_xyzw(self) -> Matrix:
        """The rotation as a unit quaternion, float64 [4], scalar last and non-negative."""
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
        """The pose as a homogeneous matrix, float64 [4, 4], row-major."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation_m
        return matrix

    def __matmul__(self, other: "Pose") -> "Pose":
        """Compose two poses: ``a_from_c = a_from_b @ b_from_c``."""
        return Pose(
            self.rotation @ other.rotation,
            self.rotation @ other.translation_m + self.translation_m,
        )

    def inverse(self) -> "Pose":
        """Return ``b_from_a``: the pose that undoes this one."""
        back = self.rotation.T
        return Pose(back, -back @ self.translation_m)

    def apply(self, points_b: Matrix) -> Matrix:
        """Map points [..., 3] in metres from b-coordinates to a-coordinates."""
        return points_b @ self.rotation.T + self.translation_m


class Axes(Enum):
    """The axis convention in which a client states its poses, world and camera alike.

    The value is the matrix that takes a vector of that convention to OpenCV axes. All are
    signed permutations; Unity's has determinant -1, because Unity is left-handed.
    """

    OPENCV = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    """x right, y down, z forward."""
    OPENXR = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
    """x right, y up, z back; the axes of OpenXR and OpenGL."""
    UNITY = ((1, 0, 0), (0, -1, 0), (0, 0, 1))
    """x right, y up, z forward; left-handed."""
    NED = ((0, 1, 0), (0, 0, 1), (1, 0, 0))
    """x forward, y right, z down; the axes of aircraft and drones."""
    ROS = ((0, -1, 0), (0, 0, -1), (1, 0, 0))
    """x forward, y left, z up; the body axes of ROS (REP 103). Its optical frames have the axes of
    :attr:`OPENCV`."""

    def to_opencv(self, pose: Pose) -> Pose:
        """Convert a pose stated in these axes to OpenCV axes; the motion is the same."""
        opencv_from_self = np.array(self.value, np.float64)
        return Pose(
            opencv_from_self @ pose.rotation @ opencv_from_self.T,
            opencv_from_self @ pose.translation_m,
        )

    def from_opencv(self, pose: Pose) -> Pose:
        """Convert a pose stated in OpenCV axes to these axes; undoes :meth:`to_opencv`."""
        self_from_opencv = np.array(self.value, np.float64).T
        return Pose(
            self_from_opencv @ pose.rotation @ self_from_opencv.T,
            self_from_opencv @ pose.translation_m,
        )


@dataclass(frozen=True, slots=True)
class RectifiedRig:
    """A rectified camera pair: rows correspond, both cameras share focal lengths and ``cy``.

    Pixel centres sit at integer coordinates. The right camera is ``baseline_m`` to the right of the
    left one.

    Raises
    ------
    BadCalibration
        A size, focal length or baseline is not positive, or a number is not finite.
    """

    width: int
    """Width of both images in pixels."""
    height: int
    """Height of both images in pixels."""
    fx: float
    """Horizontal focal length of both cameras in pixels."""
    fy: float
    """Vertical focal length of both cameras in pixels."""
    cx_left: float
    """Column of the left camera's principal point in pixels."""
    cx_right: float
    """Column of the right camera's principal point in pixels."""
    cy: float
    """Row of both principal points in pixels."""
    baseline_m: float
    """Distance between the camera centres in metres."""

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0):
            raise BadCalibration(f"image size must be positive, got {self.width}x{self.height}")
        if not (0 < self.fx < np.inf and 0 < self.fy < np.inf):
            raise BadCalibration(
                f"focal lengths must be positive pixels, got fx={self.fx} fy={self.fy}"
            )
        centres = (self.cx_left, self.cx_right, self.cy)
        if not np.isfinite(centres).all():
            raise BadCalibration(f"principal points must be finite, got {centres}")
        if not 0 < self.baseline_m < np.inf:
            raise BadCalibration(
                f"the baseline must be a positive length in metres, got {self.baseline_m}; "
                "the right camera must be to the right of the left one"
            )

    @property
    def offset_of_zero_disparity_px(self) -> float:
        """``u_left - u_right`` in pixels of a point at infinity: ``cx_left - cx_right``.

        Middlebury's ``doffs`` is the negative of it.
        """
        return self.cx_left - self.cx_right

    def depth_from_disparity(self, disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute depth ``Z = fx * baseline_m / d`` in metres along the optical axis.

        Takes and returns float32 [H, W]. The result is NaN where the disparity is not positive.
        """
        positive = disparity_px > 0
        safe = np.where(positive, disparity_px, np.float32(1))
        depth = np.float32(self.fx * self.baseline_m) / safe
        return np.where(positive, depth, np.float32(np.nan))

    def disparity_from_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute disparity ``d = fx * baseline_m / Z`` in pixels.

        Takes and returns float32 [H, W]. The result is NaN where the depth is not positive.
        """
        return self.depth_from_disparity(depth_m)  # the map is its own inverse

    @property
    def xyzw_from_uvd(self) -> Matrix:
        """Q, float64 [4, 4]: maps (u, v, u_left - u_right, 1) to homogeneous left-camera metres."""
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
    """Return the float32 [4, 4] by which a rigid camera motion moves pixels and disparities.

    It takes homogeneous (u, v, u_left - u_right, 1) of the previous frame to the current one:
    ``Q^-1 [RT]_{curr<-prev} Q``. Stereo Matching in Time (WACV 2024, section 3.2) prints the
    product the other way round, which does not fit the Q it defines. Composed in float64.
    """
    uvd_from_xyzw = np.linalg.inv(rig.xyzw_from_uvd)
    transform = uvd_from_xyzw @ curr_from_prev.matrix @ (prev_rig or rig).xyzw_from_uvd
    return transform.astype(np.float32)


def check_rotation(rotation: Matrix) -> None:
    """Accept a float64 [3, 3] that is a rotation.

    Raises BadPose: it has another shape, is not finite, or is not orthonormal with determinant +1,
    within 0.001.
    """
    if rotation.shape == (3, 3) and np.isfinite(rotation).all():
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error <= _RIGID_TOLERANCE and np.linalg.det(rotation) > 0:
            return
    raise BadPose(
        f"expected a rotation [3, 3], finite, orthonormal, of determinant +1, got "
        f"{rotation.tolist()}; remove scale and shear, and state left-handed poses by the axes of "
        "the session and not by a mirrored matrix"
    )


def _vector(values: object, size: int, expected: str) -> Matrix:
    """Return finite numbers [size]; OpenCV's [size, 1] will do."""
    numbers = _float64(values, expected)
    if numbers.shape in ((size, 1), (1, size)):
        numbers = numbers.ravel()
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise BadPose(f"expected {expected} of {size} finite numbers, got {numbers.tolist()}")
    return numbers.copy()


def _float64(values: object, expected: str) -> Matrix:
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise BadPose(f"expected {expected} of numbers, got {str(values)[:200]}") from None
