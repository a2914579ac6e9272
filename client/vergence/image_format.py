"""The format in which images travel, and the encoding of frames in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto import codec
from vergence_proto.errors import BadShape
from vergence_proto.types import ImageEncoding, StereoFrame


@dataclass(frozen=True, slots=True)
class ImageFormat:
    """How the images of a frame travel to the server."""

    encoding: ImageEncoding
    """Raw, JPEG or PNG."""
    jpeg_quality: int = 90
    """The quality of JPEG, 1 to 100."""
    grey: bool = False
    """Colour is left out: it takes bytes and hardly helps."""
    scale: int = 1
    """2: images are sent at half size."""


def frame_request(
    frame: StereoFrame,
    form: ImageFormat,
    *,
    size: tuple[int, int],
    map_step: int = 0,
    max_age_s: float | None,
) -> bytes | Callable[[], bytes]:
    """Check a frame and return its request, or the function that makes it, for another thread.

    The caller may change the images afterwards. ``size`` is the (width, height) of the rig,
    ``map_step`` that of the answer (0: the stream's).

    Raises
    ------
    BadImage
        An image is not uint8 [H, W, 3] or [H, W], or it is empty.
    BadShape
        An image of another size than the rig's cannot be reduced.
    BadPose
        The pose is not finite, or its matrix is no rotation.
    """

    def encode() -> bytes:
        return codec.frame_to_request(
            frame,
            encoding=form.encoding,
            jpeg_quality=form.jpeg_quality,
            scale=form.scale,
            map_step=map_step,
            max_age_s=max_age_s,
        )

    if form == ImageFormat(ImageEncoding.RAW, form.jpeg_quality):
        return encode()  # a copy, and nothing else
    if frame.pose is not None:
        codec.pose_sample_to_proto(frame.pose)
    for image in (frame.left, frame.right):
        height, width = codec.check_image(image).shape[:2]
        if form.scale != 1 and (width, height) != size:
            raise BadShape(f"expected images of {size[0]}x{size[1]}, got {width}x{height}")
    frame = replace(frame, left=_copy(frame.left, form), right=_copy(frame.right, form))
    return encode


def _copy(image: NDArray[np.uint8], form: ImageFormat) -> NDArray[np.uint8]:
    if form.grey and image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return image.copy()
