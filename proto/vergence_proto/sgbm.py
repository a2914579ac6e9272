"""The classical baseline of studies and of the server: OpenCV's StereoSGBM, three-way.

Its holes are filled from the sides.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Image = NDArray[np.uint8]


def sgbm_disparity(
    left: Image, right: Image, *, max_disparity_px: int = 128, scale: float = 1.0
) -> Plane:
    """Dense disparity in px of the full image, [H, W]; see :func:`sgbm_matches`."""
    dense, _ = sgbm_matches(left, right, max_disparity_px=max_disparity_px, scale=scale)
    return dense


def sgbm_matches(
    left: Image, right: Image, *, max_disparity_px: int, scale: float
) -> tuple[Plane, NDArray[np.bool_]]:
    """Dense disparity in px of the full image, and where it was matched, [H, W] each.

    ``left`` and ``right`` are RGB, [H, W, 3]. ``scale`` 0.5 matches at half size. The left border
    is padded, so that it is searched too; a hole takes the smaller (farther) of its two neighbours
    in the row, as an occlusion would.
    """
    height, width = left.shape[:2]
    eyes = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    if scale != 1:
        eyes = [
            cv2.resize(eye, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for eye in eyes
        ]
    search = 16 * math.ceil(max_disparity_px * scale / 16)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=search,
        blockSize=5,
        P1=8 * 25,
        P2=32 * 25,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    grown = [cv2.copyMakeBorder(eye, 0, 0, search, 0, cv2.BORDER_REPLICATE) for eye in eyes]
    found = np.asarray(matcher.compute(*grown), np.float32)[:, search:] / np.float32(16)
    dense, matched = filled(found), found > 0
    if scale == 1:
        return dense, matched
    full = cv2.resize(dense, (width, height), interpolation=cv2.INTER_LINEAR)
    seen = cv2.resize(
        matched.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST
    ).astype(np.bool_)
    return np.asarray(full, np.float32) / np.float32(scale), seen


def filled(disparity: Plane) -> Plane:
    """Holes (<= 0) take the smaller of the nearest values to either side; 0 in an empty row."""
    from_left = carried_right(disparity)
    from_right = carried_right(disparity[:, ::-1])[:, ::-1]
    dense = np.where(disparity > 0, disparity, np.minimum(from_left, from_right))
    return np.where(np.isfinite(dense), dense, 0).astype(np.float32)


def carried_right(disparity: Plane) -> Plane:
    """Each hole takes the last value to its left; infinity where there is none."""
    columns = np.where(disparity > 0, np.arange(disparity.shape[1]), -1)
    last = np.maximum.accumulate(columns, axis=1)
    values = np.take_along_axis(disparity, np.maximum(last, 0), axis=1)
    return np.where(last >= 0, values, np.float32(np.inf)).astype(np.float32)
