"""The rectified left image of a frame, as a file."""

from pathlib import Path

import cv2

from vergence_proto.types import Image
from vergence_service.streams.rectify import Rectifier

_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def left_image(rectifier: Rectifier, path: Path, image: Image) -> bytes:
    """Return the left image that the maps belong to: the uploaded file, if it is rectified.

    Otherwise a PNG. ``image`` is uint8 [H, W, 3], RGB, as it was read from ``path``.
    """
    if rectifier.maps is None:
        return path.read_bytes()
    rectified = rectifier.rectified_left(image)
    _, file = cv2.imencode(".png", cv2.cvtColor(rectified, cv2.COLOR_RGB2BGR), _FAST)
    return file.tobytes()
