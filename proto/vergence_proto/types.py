"""The values that cross the border between client, service and models, as numpy and dataclasses.

They are made by the codec or by a reader, which check them; below those nothing is checked again.
"""

import re
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadCalibration, BadShape
from vergence_proto.geometry import Pose, RectifiedRig

Image = NDArray[np.uint8]  # [H, W, 3], RGB
Plane = NDArray[np.float32]  # [H, W]; NaN where there is no value

_STREAM_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")

# Two cameras count as rectified if no pixel would move by more than a few hundredths.
_RECTIFIED_TOLERANCE = 1e-6


class Distortion(Enum):
    NONE = "none"
    BROWN_CONRADY = "brown-conrady"  # k1 k2 p1 p2 [k3 [k4 k5 k6]], as OpenCV orders them
    KANNALA_BRANDT = "kannala-brandt"  # fisheye: k1 k2 k3 k4


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """One pinhole or fisheye camera. Lengths in pixels; pixel centres sit at integers.

    Raises BadCalibration: a size or focal length that is not positive, a value that is not finite,
    or a number of coefficients that the distortion model does not have.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = Distortion.NONE
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
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
        """K [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)


_COEFFICIENT_COUNTS = {
    Distortion.NONE: (0,),
    Distortion.BROWN_CONRADY: (4, 5, 8),
    Distortion.KANNALA_BRANDT: (4,),
}


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """Two cameras as they are, rectified or not.

    Raises BadCalibration: different image sizes, or a baseline of zero.
    """

    left: Intrinsics
    right: Intrinsics
    left_from_right: Pose  # OpenCV camera axes, metres

    def __post_init__(self) -> None:
        if (self.left.width, self.left.height) != (self.right.width, self.right.height):
            raise BadCalibration(
                f"both images must have one size, got left {self.left.width}x{self.left.height} "
                f"and right {self.right.width}x{self.right.height}"
            )
        baseline_m = float(np.linalg.norm(self.left_from_right.translation_m))
        if not np.isfinite(baseline_m) or baseline_m <= 0:
            raise BadCalibration(
                f"the baseline must be a positive length in metres, got {baseline_m}; "
                "without one, disparity says nothing about depth"
            )

    @classmethod
    def from_rectified(cls, rig: RectifiedRig) -> "StereoRig":
        left = Intrinsics(rig.width, rig.height, rig.fx, rig.fy, rig.cx_left, rig.cy)
        right = Intrinsics(rig.width, rig.height, rig.fx, rig.fy, rig.cx_right, rig.cy)
        return cls(left, right, Pose(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0])))

    def as_rectified(self) -> RectifiedRig | None:
        """The same rig as a rectified one if its rows already correspond, else None."""
        left, right = self.left, self.right
        if left.distortion is not Distortion.NONE or right.distortion is not Distortion.NONE:
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


@dataclass(frozen=True, slots=True, eq=False)
class PoseSample:
    """Where the left camera was at mid-exposure, and how far that can be trusted.

    The flags are those of OpenXR's XrSpaceLocationFlags: valid means usable, tracked means
    measured and not predicted.
    """

    world_from_left: Pose  # in the stream's axes until the engine converts it
    orientation_valid: bool = True
    position_valid: bool = True
    tracked: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class StereoFrame:
    """One pair, decoded."""

    frame_id: int  # from 1, strictly increasing within a stream
    capture_ns: int  # client's monotonic clock, mid-exposure
    left: Image
    right: Image  # same shape as left
    pose: PoseSample | None = None


class ImageEncoding(Enum):
    """How an image travels."""

    RAW = "raw"  # mono8 or rgb8, by the number of channels
    JPEG = "jpeg"
    PNG = "png"


class PlaneEncoding(Enum):
    """How a disparity map travels."""

    UINT16 = "uint16"  # fixed point, 0 = no value
    FLOAT16 = "float16"
    FLOAT32 = "float32"


class Delivery(Enum):
    NEWEST = "newest"  # live: a newer frame displaces one that waits
    EVERY = "every"  # lossless: every frame is stepped, in order, and the sender waits


@dataclass(frozen=True, slots=True)
class OutputFormat:
    """What a client wants back. The default is exact to 1/64 px and the smallest."""

    encoding: PlaneEncoding = PlaneEncoding.UINT16
    denominator: int = 64  # of UINT16, 16 to 64: stored = round(value * denominator)
    compressed: bool = True  # UINT16 only; lossless
    confidence: bool = False
    sigma: bool = False


class Origin(Enum):
    """Why the state a step ran on was what it was; the names are those of the wire."""

    WARM = "warm"
    COLD_START = "cold start"
    RESUMED = "resumed"
    RESET_REQUESTED = "reset requested"
    RESET_POSE_LOST = "pose lost"
    RESET_POSE_JUMP = "pose jump"
    RESET_GAP = "gap"
    RESET_TIME_BACKWARDS = "time went backwards"
    RESET_NON_FINITE = "result was not finite"


@dataclass(frozen=True, slots=True)
class Timings:
    """Where the server's time went, in seconds."""

    decode_s: float = 0.0
    queue_s: float = 0.0
    model_s: float = 0.0
    encode_s: float = 0.0
    total_s: float = 0.0  # from the frame's arrival to the hand-over of its answer


@dataclass(frozen=True, slots=True, eq=False)
class DisparityMap:
    """The answer to one frame, in the rectified left image."""

    frame_id: int
    capture_ns: int
    rig: RectifiedRig
    disparity_px: Plane  # positive; Z = fx * baseline / d; NaN where there is no value
    sigma_px: Plane | None = None  # expected absolute error
    confidence: NDArray[np.uint8] | None = None  # probability of an error below 1 px, times 255
    world_from_left: Pose | None = None  # the rectified camera's, as the warp used it
    origin: Origin = Origin.WARM
    step_count: int = 1  # steps since the state was new, this one included
    iterations: int = 1
    frames_skipped: int = 0  # sent but not stepped since the last map
    timings: Timings = field(default_factory=Timings)

    @property
    def depth_m(self) -> Plane:
        """Metres along the optical axis; NaN where there is no value."""
        return self.rig.depth_from_disparity(self.disparity_px)

    @property
    def offset_px(self) -> Plane:
        """u_left - u_right as the images show it: what stereo data sets call disparity."""
        return self.disparity_px + np.float32(self.rig.offset_of_zero_disparity_px)

    @property
    def valid(self) -> NDArray[np.bool_]:
        return np.isfinite(self.disparity_px)


def checked_stream_id(stream_id: str) -> str:
    """Return the id unchanged. Raises BadShape: it could not travel in a header or a URL."""
    if not _STREAM_ID.fullmatch(stream_id):
        raise BadShape(
            "expected a stream id of 1 to 128 characters of A-Z a-z 0-9 . _ -, "
            f"got {stream_id[:200]!r}"
        )
    return stream_id
