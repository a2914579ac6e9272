"""One frame of a job, as a program uses it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.images import decode_image
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.job_results.points import points_of
from vergence_proto.types import DisparityMap, Image, Plane


@dataclass(frozen=True, slots=True, eq=False)
class BatchFrame:
    """One frame of a job. A frame without a map has an ``error``, and its maps are None."""

    index: int
    """The position in the sequence, from 0."""
    error: str | None
    """The reason why the frame has no map; None: it has one."""
    left_name: str
    """The name of the left image in the upload."""
    right_name: str
    """The name of the right image in the upload."""
    capture_ns: int
    """Time of mid-exposure in nanoseconds, as the upload states it."""
    world_from_left: Pose | None
    """Pose of the rectified left camera: OpenCV axes, metres; None if it is not known."""
    origin: str | None
    """The reason why the step began without a state, in words; "warm": it had one."""
    mean_sigma_px: float | None
    """Mean expected error of the pixels with a value, in pixels."""
    _frame: JobFrame = field(repr=False)

    @classmethod
    def of(cls, frame: JobFrame) -> "BatchFrame":
        """Take a frame as it was received."""
        record = frame.record
        return cls(
            record.index,
            record.error,
            record.left,
            record.right,
            record.capture_ns,
            record.world_from_left,
            record.origin,
            record.mean_sigma_px,
            frame,
        )

    @property
    def map(self) -> DisparityMap | None:
        """All maps with their rig, rounded to 1/64 px."""
        return self._frame.disparity

    @property
    def rig(self) -> RectifiedRig | None:
        """The rectified rig that the maps belong to."""
        return None if self.map is None else self.map.rig

    @property
    def disparity_px(self) -> Plane | None:
        """Float32 [H, W], pixels, positive; NaN: no value."""
        return None if self.map is None else self.map.disparity_px

    @property
    def depth_m(self) -> Plane | None:
        """Float32 [H, W], metres along the optical axis; NaN: no value."""
        return None if self.map is None else self.map.depth_m

    @property
    def sigma_px(self) -> Plane | None:
        """Float32 [H, W], expected absolute error in pixels; None unless ``outputs`` has it."""
        return None if self.map is None else self.map.sigma_px

    @property
    def confidence(self) -> NDArray[np.uint8] | None:
        """Uint8 [H, W], probability of an error below 1 px times 255; None unless requested."""
        return None if self.map is None else self.map.confidence

    @property
    def left(self) -> Image | None:
        """The rectified left image, uint8 [H, W, 3] RGB; None unless ``outputs`` has it."""
        return None if self._frame.left is None else decode_image(self._frame.left)

    def points(self, *, min_confidence: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the points of the frame and their colours.

        Parameters
        ----------
        min_confidence
            Leave out less certain points, 0 to 255; the job must have kept ``confidence``.

        Returns
        -------
        xyz_m
            Float32 [N, 3], metres, OpenCV axes: in the world if the frame has a pose, otherwise in
            the rectified left camera.
        rgb
            Uint8 [N, 3]; white unless ``outputs`` has "left".
        """
        return points_of(self._frame, min_confidence=min_confidence)
