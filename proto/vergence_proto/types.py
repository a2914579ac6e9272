"""The values that client, service and models exchange, as dataclasses of numpy arrays.

The codec and the data set readers make them and check them. Code below those does not check again.
"""

import math
import re
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadCalibration, BadPose, BadShape
from vergence_proto.geometry import Pose, RectifiedRig, check_rotation

Image = NDArray[np.uint8]  # [H, W, 3], RGB
Plane = NDArray[np.float32]  # [H, W]; NaN where there is no value

_STREAM_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")

# Two cameras count as rectified if no pixel would move by more than a few hundredths.
_RECTIFIED_TOLERANCE = 1e-6


class Distortion(Enum):
    """The lens model of a camera."""

    NONE = "none"
    """A pinhole camera without coefficients."""
    BROWN_CONRADY = "brown-conrady"
    """Radial and tangential: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], in OpenCV's order,
    with thin prisms (s) and a tilted sensor (t)."""
    KANNALA_BRANDT = "kannala-brandt"
    """Fisheye: k1 k2 k3 k4, in OpenCV's order."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """One pinhole or fisheye camera. Lengths in pixels; pixel centres sit at integers.

    Raises
    ------
    BadCalibration
        A size or focal length is not positive, a value is not finite, or the distortion model does
        not take this number of coefficients.
    """

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    """Horizontal focal length in pixels."""
    fy: float
    """Vertical focal length in pixels."""
    cx: float
    """Column of the principal point in pixels."""
    cy: float
    """Row of the principal point in pixels."""
    distortion: Distortion = Distortion.NONE
    """The lens model that ``coefficients`` belong to."""
    coefficients: tuple[float, ...] = ()
    """Distortion coefficients in OpenCV's order; empty for ``Distortion.NONE``."""

    def __post_init__(self) -> None:
        try:
            flat = np.ravel(np.asarray(self.coefficients, np.float64))  # OpenCV returns [1, n]
        except (TypeError, ValueError):
            raise BadCalibration(
                f"expected distortion coefficients as numbers, got {self.coefficients!r}"
            ) from None
        object.__setattr__(self, "coefficients", tuple(flat.tolist()))
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not np.isfinite(numbers).all():
            raise BadCalibration(f"intrinsics must be finite, got {numbers}")
        if self.width <= 0 or self.height <= 0:
            raise BadCalibration(f"image size must be positive, got {self.width}x{self.height}")
        if self.fx <= 0 or self.fy <= 0:
            raise BadCalibration(
                f"focal lengths must be positive pixels, got fx={self.fx} fy={self.fy}"
            )
        allowed = _COEFFICIENT_COUNTS[self.distortion]
        if len(self.coefficients) not in allowed:
            raise BadCalibration(
                f"{self.distortion.value} distortion takes {' or '.join(map(str, allowed))} "
                f"coefficients, got {len(self.coefficients)}"
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The camera matrix K, float64 [3, 3], in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)


_COEFFICIENT_COUNTS = {
    Distortion.NONE: (0,),
    Distortion.BROWN_CONRADY: (4, 5, 8, 12, 14),
    Distortion.KANNALA_BRANDT: (4,),
}


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """Two cameras as they are, rectified or not.

    Raises
    ------
    BadCalibration
        The image sizes differ, ``left_from_right`` is no rigid transform, or the baseline is zero.
    """

    left: Intrinsics
    """The left camera."""
    right: Intrinsics
    """The right camera; its images have the size of the left ones."""
    left_from_right: Pose
    """Maps right-camera to left-camera coordinates: OpenCV camera axes, metres."""

    def __post_init__(self) -> None:
        if (self.left.width, self.left.height) != (self.right.width, self.right.height):
            raise BadCalibration(
                f"both images must have one size, got left {self.left.width}x{self.left.height} "
                f"and right {self.right.width}x{self.right.height}"
            )
        try:
            if not isinstance(self.left_from_right, Pose):  # a matrix
                object.__setattr__(self, "left_from_right", Pose.from_matrix(self.left_from_right))
            check_rotation(self.left_from_right.rotation)
        except BadPose as error:
            raise BadCalibration(f"left_from_right: {error}") from None
        with np.errstate(over="ignore"):
            baseline_m = float(np.linalg.norm(self.left_from_right.translation_m))
        if not np.isfinite(baseline_m) or baseline_m <= 0:
            raise BadCalibration(
                f"the baseline must be a positive length in metres, got {baseline_m}; "
                "without one, disparity says nothing about depth"
            )

    @classmethod
    def load(
        cls,
        path: Path | str,
        right: Path | str | None = None,
        *,
        size: tuple[int, int] | None = None,
        unit_m: float = 1.0,
    ) -> "StereoRig":
        """Read a rig from the file of a calibration tool; the format is recognised.

        See :func:`vergence_proto.calibration.load_calibration` for formats, parameters and errors.
        """
        from vergence_proto.calibration import load_calibration  # it makes rigs

        return load_calibration(path, right, size=size, unit_m=unit_m).rig

    @classmethod
    def from_rectified(cls, rig: RectifiedRig) -> "StereoRig":
        """Make the general form of a rectified rig."""
        left = Intrinsics(rig.width, rig.height, rig.fx, rig.fy, rig.cx_left, rig.cy)
        right = Intrinsics(rig.width, rig.height, rig.fx, rig.fy, rig.cx_right, rig.cy)
        return cls(left, right, Pose(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0])))

    def as_rectified(self) -> RectifiedRig | None:
        """Return the same rig as a rectified one if its rows already correspond, else None."""
        left, right = self.left, self.right
        if _bends(left) or _bends(right):
            return None
        baseline_m, *off_axis = self.left_from_right.translation_m
        differences = np.array(
            [
                *(self.left_from_right.rotation - np.eye(3)).ravel(),
                *off_axis / np.abs(baseline_m or 1.0),
                left.fx / right.fx - 1,
                left.fy / right.fy - 1,
                (left.cy - right.cy) / left.height,
            ]
        )
        if baseline_m <= 0 or np.abs(differences).max() > _RECTIFIED_TOLERANCE:
            return None
        return RectifiedRig(
            left.width, left.height, left.fx, left.fy, left.cx, right.cx, left.cy, float(baseline_m)
        )


def _bends(camera: Intrinsics) -> bool:
    """Return whether a lens distorts: a Brown-Conrady one of zeros is a pinhole camera."""
    if camera.distortion is Distortion.BROWN_CONRADY:
        return any(camera.coefficients)
    return camera.distortion is not Distortion.NONE


@dataclass(frozen=True, slots=True, eq=False)
class PoseSample:
    """The pose of the left camera at mid-exposure, with its tracking flags.

    The flags are those of OpenXR's XrSpaceLocationFlags.
    """

    world_from_left: Pose
    """Maps left-camera to world coordinates, in the axes of the session, metres."""
    orientation_valid: bool = True
    """The orientation can be used."""
    position_valid: bool = True
    """The position can be used."""
    tracked: bool = True
    """The pose was measured, and not predicted or inferred."""

    def __post_init__(self) -> None:
        if not isinstance(self.world_from_left, Pose):  # a matrix
            object.__setattr__(self, "world_from_left", Pose.from_matrix(self.world_from_left))


@dataclass(frozen=True, slots=True, eq=False)
class StereoFrame:
    """One decoded stereo pair."""

    frame_id: int
    """The id of the frame, from 1, strictly increasing within a stream."""
    capture_ns: int
    """Time of mid-exposure in nanoseconds, on the client's monotonic clock."""
    left: Image
    """The left image, uint8 [H, W, 3], RGB."""
    right: Image
    """The right image; it has the shape of the left one."""
    pose: PoseSample | None = None
    """The pose of the left camera; None if it is not known."""


class ImageEncoding(Enum):
    """The format in which images travel to the server."""

    RAW = "raw"
    """Uncompressed and exact: mono8 or rgb8, by the number of channels."""
    JPEG = "jpeg"
    """Small and lossy; the session's ``jpeg_quality`` applies."""
    PNG = "png"
    """Compressed and exact; encoding takes time."""


class PlaneEncoding(Enum):
    """The number format in which disparity travels to the client."""

    UINT16 = "uint16"
    """Fixed point, see :attr:`OutputFormat.denominator`; 0 means no value."""
    FLOAT16 = "float16"
    """IEEE half precision."""
    FLOAT32 = "float32"
    """IEEE single precision: the bits that the model returned."""


class Delivery(Enum):
    """What the server does with a frame while an older one of the stream is still waiting."""

    NEWEST = "newest"
    """Live: the newer frame displaces the one that waits."""
    EVERY = "every"
    """Lossless: every frame is stepped, in order, and the sender waits."""


@dataclass(frozen=True, slots=True)
class OutputFormat:
    """The content and precision of results.

    A value of 0 is chosen by the session: the smallest maps for live sessions off this machine, and
    maps exact to 1/64 px otherwise.
    """

    encoding: PlaneEncoding = PlaneEncoding.UINT16
    """The number format of the disparity map."""
    denominator: int = 0
    """UINT16 only, 4 to 64: the stored number is ``round(disparity_px * denominator)``. 0: 16 for
    live sessions off this machine, else 64."""
    compressed: bool = True
    """UINT16 only: compress the map without loss."""
    confidence: bool = False
    """Request :attr:`DisparityMap.confidence`."""
    sigma: bool = False
    """Request :attr:`DisparityMap.sigma_px`."""
    map_step: int = 0
    """Send every first, second or fourth row and column: 1, 2 or 4. The client interpolates the
    others. 0: 2 for UINT16 and live sessions off this machine, else 1."""
    deflate: bool = False
    """Compress by deflate in place of zstd: slower, and available in browsers."""

    def resolved(self, *, small: bool = False) -> "OutputFormat":
        """Return the format with values for zeros: for small messages, or exact ones."""
        small = small and self.encoding is PlaneEncoding.UINT16
        return replace(
            self,
            denominator=self.denominator or (16 if small else 64),
            map_step=self.map_step or (2 if small else 1),
        )


class Origin(Enum):
    """The reason why a step ran on the state that it ran on; names are those of the wire."""

    WARM = "warm"
    """The step continued from the previous frame."""
    COLD_START = "cold start"
    """The first frame of a stream: there was no state."""
    RESUMED = "resumed"
    """The first frame after a reconnection; the state was kept."""
    RESET_REQUESTED = "reset requested"
    """The client asked for a reset."""
    RESET_POSE_LOST = "pose lost"
    """This frame or the previous one has no usable pose."""
    RESET_POSE_JUMP = "pose jump"
    """The camera moved too far between two frames."""
    RESET_GAP = "gap"
    """Too much time passed between two frames."""
    RESET_TIME_BACKWARDS = "time went backwards"
    """The capture time is before that of the previous frame."""
    RESET_NON_FINITE = "result was not finite"
    """The previous result contained numbers that are not finite."""


@dataclass(frozen=True, slots=True)
class Timings:
    """The server's time for one frame, by stage, in seconds."""

    decode_s: float = 0.0
    """Time to decode the images."""
    queue_s: float = 0.0
    """Time that the frame waited for its turn."""
    model_s: float = 0.0
    """Time of the network."""
    encode_s: float = 0.0
    """Time to encode the result."""
    total_s: float = 0.0
    """Time from the frame's arrival to the hand-over of its result to the transport."""


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedPlanes:
    """The planes of a result as they were received: every step-th row and column, from the first.

    The pixel (i, j) is the pixel (step * i, step * j) of the result. Values are in pixels of the
    whole image.
    """

    step: int
    """The distance between two of these pixels in the result: 1, 2 or 4."""
    disparity_px: Plane
    """Float32 [ceil(H / step), ceil(W / step)], pixels; NaN: no value."""
    sigma_px: Plane | None = None
    """Float32, of the same shape; None if not requested."""
    confidence: NDArray[np.uint8] | None = None
    """Uint8, of the same shape; None if not requested."""


@dataclass(frozen=True, slots=True, eq=False)
class DisparityMap:
    """The result of one frame, in the pixels of the rectified left image."""

    frame_id: int
    """The id of the frame, as :meth:`vergence.DepthSession.submit` returned it."""
    capture_ns: int
    """The frame's capture time in nanoseconds, as it was sent."""
    rig: RectifiedRig
    """The rectified rig that disparity, depth and pixels refer to."""
    disparity_px: Plane
    """Float32 [H, W], pixels, positive: ``Z = fx * baseline_m / disparity_px``; NaN: no value."""
    sigma_px: Plane | None = None
    """Float32 [H, W], pixels: expected absolute error of the disparity; None if not requested."""
    confidence: NDArray[np.uint8] | None = None
    """Uint8 [H, W]: probability of an error below 1 px, times 255; None if not requested."""
    world_from_left: Pose | None = None
    """The pose of the rectified left camera that the step used; None if the frame had none."""
    origin: Origin = Origin.WARM
    """The reason why the step ran on its state; anything but WARM and RESUMED was a new start."""
    step_count: int = 1
    """Steps since the state was new, this one included."""
    iterations: int = 1
    """Refinement iterations of this step."""
    frames_skipped: int = 0
    """Frames that were sent and not stepped since the previous result."""
    timings: Timings = field(default_factory=Timings)
    """The server's time for this frame."""
    max_disparity_px: float = math.inf
    """The range of the search in pixels: what is nearer than its depth has no value."""

    @property
    def depth_m(self) -> Plane:
        """Depth in metres along the optical axis, float32 [H, W]; NaN where there is no value."""
        return self.rig.depth_from_disparity(self.disparity_px)

    @property
    def offset_px(self) -> Plane:
        """``u_left - u_right`` in pixels, float32 [H, W]: what stereo data sets call disparity.

        It differs from ``disparity_px`` where the principal points differ.
        """
        return self.disparity_px + np.float32(self.rig.offset_of_zero_disparity_px)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Bool [H, W]: true where the disparity has a value."""
        return np.isfinite(self.disparity_px)


def checked_stream_id(stream_id: str) -> str:
    """Return the id unchanged. Raises BadShape: it could not travel in a header or a URL."""
    if not _STREAM_ID.fullmatch(stream_id):
        raise BadShape(
            "expected a stream id of 1 to 128 characters of A-Z a-z 0-9 . _ -, "
            f"got {stream_id[:200]!r}"
        )
    return stream_id
