"""The stereo source that every reader returns, and its frames."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.images import read_image
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Plane, PoseSample, StereoFrame, StereoRig

Mask = NDArray[np.bool_]

# If a data set states no times, its frames are 1/30 s apart, as those of most cameras, so that
# no stream takes the interval for a gap.
NOMINAL_FPS = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The known disparity of one frame."""

    offset_px: Plane
    """float32 [H, W]: u_left - u_right in the images; NaN where it is unknown."""
    mask: Mask | None = None
    """bool [H, W]: pixels to evaluate, without mirrors and metal, whose truth no camera sees."""
    visible: Mask | None = None
    """bool [H, W]: pixels that the right camera sees too; None if the data set does not say."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceFrame:
    """One frame as read from disk, with OpenCV axes and metres."""

    frame: StereoFrame
    """The decoded images, the time of capture, and the pose if there is one."""
    truth_px: Plane | None = None
    """float32 [H, W]: u_left - u_right in the images; NaN where it is unknown."""
    truth_mask: Mask | None = None
    """bool [H, W]: pixels to evaluate; all of them if the data set does not say."""
    visible: Mask | None = None
    """bool [H, W]: pixels that the right camera sees too; None if the data set does not say."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFiles:
    """The files of one frame."""

    left: Path
    right: Path
    capture_ns: int
    world_from_left: Pose | None = None
    read_truth: Callable[[], Truth] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StereoSource:
    """A sequence, or a single pair as a sequence of length 1. Each frame is read when it is used.

    Reading a frame raises DatasetError: an image is missing, damaged, or not of the rig's size.
    """

    name: str
    rig: StereoRig
    fps: float | None
    """Frames per second; None for a single pair, or if the times are unknown."""
    files: Sequence[FrameFiles]
    """The files of each frame, in order."""
    notes: tuple[str, ...] = ()
    """What a user should know of this source: frames that are missing, poses that do not fit."""
    metric: bool = True
    """False if lengths are not metres, because the calibration is unknown (and a nominal one is
    used) or in the data set's own units. Disparity is not affected."""

    @property
    def is_single_pair(self) -> bool:
        """True for a pair that is no frame of a sequence."""
        return self.fps is None and len(self) == 1

    @property
    def has_truth(self) -> bool:
        """True if the ground truth of any frame is there."""
        return any(each.read_truth is not None for each in self.files)

    @property
    def missing_images(self) -> list[Path]:
        """The images that are listed and not there, in order."""
        images = (path for each in self.files for path in (each.left, each.right))
        return [path for path in images if not path.is_file()]

    def without_truth(self) -> "StereoSource":
        """Return the same frames without their ground truth, which takes time to read."""
        return replace(self, files=[replace(each, read_truth=None) for each in self.files])

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[SourceFrame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> SourceFrame:
        files = self.files[index]
        left, right = (self._image(path) for path in (files.left, files.right))
        pose = None if files.world_from_left is None else PoseSample(files.world_from_left)
        frame_id = 1 + range(len(self))[index]
        frame = StereoFrame(frame_id, files.capture_ns, left, right, pose)
        if files.read_truth is None:
            return SourceFrame(frame)
        truth = files.read_truth()
        if truth.offset_px.shape != left.shape[:2]:
            raise DatasetError(
                f"{self.name}: the truth of frame {frame_id} is {truth.offset_px.shape[1]}x"
                f"{truth.offset_px.shape[0]}, but its image is {left.shape[1]}x{left.shape[0]}"
            )
        mask = np.ones(left.shape[:2], np.bool_) if truth.mask is None else truth.mask
        return SourceFrame(frame, truth.offset_px, mask, truth.visible)

    def _image(self, path: Path) -> NDArray[np.uint8]:
        image = read_image(path)
        expected = (self.rig.left.height, self.rig.left.width)
        if image.shape[:2] != expected:
            raise DatasetError(
                f"{path}: expected {expected[1]}x{expected[0]} as its calibration says, "
                f"got {image.shape[1]}x{image.shape[0]}"
            )
        return image


def rectified_rig(
    origin: Path,
    size: tuple[int, int],
    *,
    fx: float,
    cx: float,
    cy: float,
    baseline_m: float,
    fy: float | None = None,
    cx_right: float | None = None,
) -> StereoRig:
    """Make a rectified rig of ``size`` (width, height).

    Raises DatasetError: the numbers, read from ``origin``, are no stereo rig.
    """
    width, height = size
    try:
        if not baseline_m > 0:
            raise BadCalibration(f"the baseline must be positive, got {baseline_m}")
        return StereoRig.from_rectified(
            RectifiedRig(
                width=width,
                height=height,
                fx=fx,
                fy=fx if fy is None else fy,
                cx_left=cx,
                cx_right=cx if cx_right is None else cx_right,
                cy=cy,
                baseline_m=baseline_m,
            )
        )
    except BadCalibration as error:
        raise DatasetError(f"{origin}: {error}") from None


def nominal_ns(index: int, fps: float | None) -> int:
    """Return the time of frame ``index`` in a sequence with even spacing."""
    return round(index * 1e9 / (fps or NOMINAL_FPS))
