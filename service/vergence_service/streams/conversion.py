"""The border between a client's frames and the model's views: rectification, axes, no values."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadShape
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import DisparityMap, Origin, Plane, StereoFrame, Timings
from vergence_service.inference.batcher import TimedResult
from vergence_service.inference.model import StereoView
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import Stream


def view_from_frame(frame: StereoFrame, rectifier: Rectifier, axes: Axes) -> StereoView:
    """The frame as the model sees it: rectified, its pose in OpenCV axes.

    Raises BadShape: images of another size than the rig's.
    """
    rig = rectifier.rig
    height, width = frame.left.shape[:2]
    if (width, height) != (rig.width, rig.height):
        raise BadShape(
            f"expected images of {rig.width}x{rig.height}, the size the stream was opened with, "
            f"got {width}x{height}"
        )
    left, right = rectifier.rectify(frame.left, frame.right)
    world_from_rectified: Pose | None = None
    if frame.pose is not None and frame.pose.orientation_valid:
        world_from_left = axes.to_opencv(frame.pose.world_from_left)
        world_from_rectified = world_from_left @ rectifier.left_from_rectified
    position_known = frame.pose is not None and frame.pose.position_valid
    return StereoView(left, right, rig, frame.capture_ns, world_from_rectified, position_known)


@dataclass(frozen=True, slots=True, eq=False)
class SteppedFrame:
    """A step that was taken, on its way to becoming a disparity map."""

    stream: Stream
    frame_id: int
    view: StereoView
    timed: TimedResult
    origin: Origin
    iterations: int
    frames_skipped: int
    timings: Timings

    def disparity_map(self) -> DisparityMap:
        """Works on whole images: to be called in a worker thread."""
        result, config = self.timed.result, self.stream.config
        pose = self.view.world_from_left
        return DisparityMap(
            frame_id=self.frame_id,
            capture_ns=self.view.capture_ns,
            rig=self.view.rig,
            disparity_px=_disparity_px(result.offset_px, self.stream.rectifier),
            sigma_px=result.sigma_px if config.output.sigma else None,
            confidence=_confidence(result.sigma_px) if config.output.confidence else None,
            world_from_left=None if pose is None else config.axes.from_opencv(pose),
            origin=self.origin,
            step_count=result.state.step_count,
            iterations=self.iterations,
            frames_skipped=self.frames_skipped,
            timings=self.timings,
        )


def _disparity_px(offset_px: Plane, rectifier: Rectifier) -> Plane:
    """Pixel offset to disparity: NaN where it is not positive or the camera saw nothing."""
    disparity_px = offset_px - np.float32(rectifier.rig.offset_of_zero_disparity_px)
    there = disparity_px > 0
    if rectifier.seen is not None:
        there &= rectifier.seen
    disparity_px[~there] = np.nan
    return disparity_px


def _confidence(sigma_px: Plane) -> NDArray[np.uint8]:
    """The probability of an error below one pixel, times 255.

    Of a Laplace distribution, whose expected absolute error is its scale.
    """
    probability: Plane = 1 - np.exp(-1 / np.maximum(sigma_px, np.float32(1e-6)))
    return np.rint(probability * 255).astype(np.uint8)
