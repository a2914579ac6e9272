"""The format in which images travel, and the encoding of frames in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto import codec
from vergence_proto.errors import BadShape
from vergence_proto.opencv import cv2
from vergence_proto.types import ImageEncoding, StereoFrame

CameraImage = NDArray[np.uint8] | bytes | bytearray | memoryview
"""An image as cameras give it, of the rig's size [H, W].

Arrays are uint8: [H, W] grey, [H, W, 3] RGB, [H, W, 4] RGBA, whose alpha is ignored, or
[H * 3/2, W] NV12 (also NV21 and I420), of which the luma rows are used. Bytes are a JPEG or PNG
file, which travels as it is.
"""

_RGBA = 4


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

    The caller may change the images afterwards. They are as :func:`sent_image` returns them.
    ``size`` is the (width, height) of the rig, ``map_step`` that of the answer (0: the stream's).

    Raises
    ------
    BadImage
        An image has another type or shape, is empty, or is a file of another kind or cut short.
    BadShape
        An image of another size than the rig's cannot be reduced.
    BadPose
        The pose is not finite, or its matrix is no rotation.
    """
    images: list[Any] = [frame.left, frame.right]
    if any(isinstance(image, bytes) for image in images):
        form = replace(form, scale=1)  # a file travels as it is

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
    for image in images:
        if isinstance(image, bytes):
            continue
        height, width = codec.check_image(image).shape[:2]
        if form.scale != 1 and (width, height) != size:
            raise BadShape(f"expected images of {size[0]}x{size[1]}, got {width}x{height}")
    frame = replace(frame, left=_copy(frame.left, form), right=_copy(frame.right, form))
    return encode


def sent_image(image: CameraImage, size: tuple[int, int]) -> Any:
    """Return a file as bytes, or an image as grey or RGB: without alpha, and the luma of NV12.

    ``size`` is the (width, height) of the rig.

    Raises
    ------
    BadImage
        A file is neither JPEG nor PNG, or cut short.
    BadShape
        A file has another size than the rig.
    """
    width, height = size
    if isinstance(image, (bytes, bytearray, memoryview)):
        file = codec.camera_file(bytes(image))
        if (file.width, file.height) != size:
            raise BadShape(
                f"expected images of {width}x{height}, as the rig has, got a {file.kind.value} of "
                f"{file.width}x{file.height}"
            )
        return bytes(image)
    if image.ndim == 3 and image.shape[2] == _RGBA:
        return image[..., :3]
    if image.ndim == 2 and image.shape == (height + height // 2, width) and height % 2 == 0:
        return image[:height]
    return image


def _copy(image: Any, form: ImageFormat) -> Any:
    if isinstance(image, bytes):
        return image
    if form.grey and image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return image.copy()
