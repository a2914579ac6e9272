"""What every reader gives: a stereo source, one frame after the other."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets.files import LayoutError
from vergence_proto.datasets.images import read_image
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Plane, PoseSample, StereoFrame, StereoRig

Mask = NDArray[np.bool_]

# Frames of a layout that states no times are taken to be a camera's usual 30 Hz apart, so that
# nothing downstream sees a gap.
NOMINAL_FPS = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is known about the disparity of one frame."""

    offset_px: Plane  # u_left - u_right in the images, NaN where unknown
    # Pixels to judge by. Left out: mirrors and metal, whose truth no camera can see.
    mask: Mask | None = None
    visible: Mask | None = None  # what the right camera sees too, where the layout tells


@dataclass(frozen=True, slots=True, eq=False)
class SourceFrame:
    """One frame as read from disk, OpenCV axes, metres."""

    frame: StereoFrame
    truth_px: Plane | None = None  # as Truth.offset_px
    truth_mask: Mask | None = None  # as Truth.mask; all true where the layout tells nothing
    visible: Mask | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameFiles:
    """Where one frame lies on disk."""

    left: Path
    right: Path
    capture_ns: int
    world_from_left: Pose | None = None
    read_truth: Callable[[], Truth] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StereoSource:
    """A sequence, or a lone pair as one of length 1. Frames are read as they are asked for.

    Raises LayoutError from reading: an image that is missing, damaged, or not of the rig's size.
    """

    name: str
    rig: StereoRig
    fps: float | None  # None: a pair, or times unknown
    files: Sequence[FrameFiles]
    # False: lengths are not metres, because the calibration is unknown (and a nominal one stands
    # in) or in units of the data set's own. Disparity is as good as ever.
    metric: bool = True

    @property
    def is_single_pair(self) -> bool:
        """Whether this is one pair on its own and not one frame of a sequence."""
        return self.fps is None and len(self) == 1

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
            raise LayoutError(
                f"{self.name}: the truth of frame {frame_id} is {truth.offset_px.shape[1]}x"
                f"{truth.offset_px.shape[0]}, its image {left.shape[1]}x{left.shape[0]}"
            )
        mask = np.ones(left.shape[:2], np.bool_) if truth.mask is None else truth.mask
        return SourceFrame(frame, truth.offset_px, mask, truth.visible)

    def _image(self, path: Path) -> NDArray[np.uint8]:
        image = read_image(path)
        expected = (self.rig.left.height, self.rig.left.width)
        if image.shape[:2] != expected:
            raise LayoutError(
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
    """A rectified rig of ``size`` (width, height).

    Raises LayoutError: the numbers that ``origin`` gave are no stereo rig.
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
        raise LayoutError(f"{origin}: {error}") from None


def nominal_ns(index: int, fps: float | None) -> int:
    """When frame ``index`` was captured if frames are evenly spaced."""
    return round(index * 1e9 / (fps or NOMINAL_FPS))
