"""Convert between a client's frames and the model's views: rectification, axes, missing values."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vergence_proto.accuracy import confidence_from_sigma
from vergence_proto.errors import BadShape
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import DisparityMap, Origin, StereoFrame, Timings
from vergence_service.inference.model import StepResult, StereoView
from vergence_service.process.failures import out_of_memory
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import Stream


def view_from_frame(frame: StereoFrame, rectifier: Rectifier, axes: Axes) -> StereoView:
    """Convert a frame to the model's input: rectified images, and the pose in OpenCV axes.

    Raises BadShape if the images do not have the size of the rig.
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
    return StereoView(
        left, right, rectifier.window.rig, frame.capture_ns, world_from_rectified, position_known
    )


@dataclass(frozen=True, slots=True, eq=False)
class SteppedFrame:
    """A frame that was stepped, before its answer is made."""

    stream: Stream
    frame_id: int
    arrived_s: float
    view: StereoView
    result: StepResult
    origin: Origin
    iterations: int
    frames_skipped: int
    timings: Timings  # up to the end of the step

    def disparity_map(self) -> DisparityMap:
        """Make the answer. This works on whole images: call it in a worker thread."""
        result, config = self.result, self.stream.config
        pose, rectifier = self.view.world_from_left, self.stream.rectifier
        sigma_px = rectifier.sigma_px(result.sigma_px)
        disparity_px = rectifier.disparity_px(result.offset_px)
        confidence: NDArray[np.uint8] | None = None
        if config.output.confidence:
            confidence = confidence_from_sigma(sigma_px)
            confidence[np.isnan(disparity_px)] = 0
        return DisparityMap(
            frame_id=self.frame_id,
            capture_ns=self.view.capture_ns,
            rig=rectifier.rig,
            disparity_px=disparity_px,
            sigma_px=sigma_px if config.output.sigma else None,
            confidence=confidence,
            world_from_left=None if pose is None else config.axes.from_opencv(pose),
            origin=self.origin,
            step_count=result.state.step_count,
            iterations=self.iterations,
            frames_skipped=self.frames_skipped,
            timings=self.timings,
            max_disparity_px=rectifier.window.max_disparity_px,
        )


def decoded_view(decode: Callable[[], StereoFrame], stream: Stream) -> tuple[int, StereoView]:
    """Decode a frame; return its id and the model's view. Call it in a worker thread."""
    try:
        frame = decode()
        return frame.frame_id, view_from_frame(frame, stream.rectifier, stream.config.axes)
    except MemoryError:
        raise out_of_memory() from None
