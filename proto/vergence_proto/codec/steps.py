"""Small maps and images: every n-th row and column of a map, and images of half the size."""

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadShape
from vergence_proto.opencv import cv2
from vergence_proto.types import Plane

MAP_STEPS = (1, 2, 4)
FRAME_SCALES = (1, 2)
MAX_FRAME_SCALE = max(FRAME_SCALES)

# Neighbours that differ by more, in pixels for each pixel between them, belong to two surfaces.
_EDGE_SLOPE = 0.5
_BELOW_ALL_PX = -1e6


def check_map_step(step: int) -> int:
    """Return the step. Raises BadShape: it is not 1, 2 or 4."""
    if step not in MAP_STEPS:
        raise BadShape(f"expected a map_step of 1, 2 or 4, got {step}")
    return step


def reduced(size: tuple[int, int], step: int) -> tuple[int, int]:
    """Return the (width, height) of every step-th pixel of a map, or of a reduced image."""
    return -(-size[0] // step), -(-size[1] // step)


def widen_plane(plane: Plane, step: int, size: tuple[int, int]) -> Plane:
    """Return the float32 map of ``size`` (width, height) of which ``plane`` is every step-th pixel.

    Within a surface it is bilinear. Between two surfaces, and beside missing values, each pixel
    has the nearest value, so that nothing appears between the surfaces.
    """
    if step == 1:
        return plane
    wide: Plane = _warped(plane, step, size, cv2.INTER_NEAREST)
    linear = _warped(plane, step, size, cv2.INTER_LINEAR)
    # The values at each pixel, to the right, below and diagonally. A missing one makes an edge.
    corners = np.ones((2, 2), np.uint8)
    known = np.where(np.isnan(plane), np.float32(_BELOW_ALL_PX), plane)
    spread = cv2.dilate(known, corners, anchor=(0, 0)) - cv2.erode(known, corners, anchor=(0, 0))
    surface = (spread <= _EDGE_SLOPE * step).repeat(step, axis=0).repeat(step, axis=1)
    np.copyto(wide, linear, where=surface[: size[1], : size[0]])
    return wide


def widen_bytes(plane: NDArray[np.uint8], step: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the uint8 map of ``size`` (width, height); each pixel has the nearest value."""
    if step == 1:
        return plane
    return np.asarray(_warped(plane, step, size, cv2.INTER_NEAREST), np.uint8)


def enlarge_image(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an image of ``size`` (width, height), from one that :func:`reduce_image` made."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def reduce_image(image: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """Return the image with one pixel for each ``scale`` x ``scale``, rounded up: their mean."""
    height, width = image.shape[:2]
    size = reduced((width, height), scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _warped(plane: Plane | NDArray[np.uint8], step: int, size: tuple[int, int], how: int) -> Plane:
    """Place the pixel (x, y) of a plane at (step x, step y)."""
    small_from_wide = np.array([[1 / step, 0, 0], [0, 1 / step, 0]])
    flags = how | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(
        plane, small_from_wide, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, plane.dtype)
