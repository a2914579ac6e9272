"""Results without the values that a program does not want: unsure, out of range, or speckles.

Each function returns a new result whose disparity is NaN there; everything else stays.
"""

import math
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadShape
from vergence_proto.opencv import cv2
from vergence_proto.types import DisparityMap

Result = TypeVar("Result", bound=DisparityMap)

# OpenCV compares fixed-point disparities, in its own steps.
_STEPS_PER_PX = 16


def keep_confident(result: Result, min_confidence: int) -> Result:
    """Keep values whose confidence is at least ``min_confidence``, 0 to 255.

    Raises
    ------
    BadShape
        The result has no confidence; request it with ``OutputFormat(confidence=True)``.
    """
    if result.confidence is None:
        raise BadShape(
            "the result has no confidence; request it with OutputFormat(confidence=True)"
        )
    return _kept(result, result.confidence >= min_confidence)


def keep_range(result: Result, min_depth_m: float = 0.0, max_depth_m: float = math.inf) -> Result:
    """Keep values whose depth in metres lies in the range, both ends included."""
    depth_m = result.depth_m
    return _kept(result, (depth_m >= min_depth_m) & (depth_m <= max_depth_m))


def without_speckles(result: Result, max_pixels: int, max_step_px: float = 1.0) -> Result:
    """Leave out small regions of disparity, by OpenCV's ``filterSpeckles``.

    Parameters
    ----------
    result
        A result.
    max_pixels
        The size of the largest region that is left out.
    max_step_px
        Neighbours belong to one region if their disparities differ by no more.
    """
    largest = np.iinfo(np.int16).max / _STEPS_PER_PX
    known = np.nan_to_num(result.disparity_px, nan=0.0)
    steps = np.rint(np.minimum(known, largest) * _STEPS_PER_PX).astype(np.int16)
    steps[result.valid] = np.maximum(steps[result.valid], 1)  # 0 is no value
    cv2.filterSpeckles(steps, 0, max_pixels, max_step_px * _STEPS_PER_PX)
    return _kept(result, steps > 0)


def _kept(result: Result, mask: NDArray[np.bool_]) -> Result:
    disparity_px = np.where(mask, result.disparity_px, np.float32(np.nan)).astype(np.float32)
    return replace(result, disparity_px=disparity_px)
