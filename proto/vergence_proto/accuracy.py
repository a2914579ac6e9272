"""Errors of disparity against the truth, by the definitions of the field.

Disparity and truth are float32 [H, W] pixels; the truth is NaN where it is unknown. A pixel with
truth but without a finite prediction counts as a prediction of zero, so leaving hard pixels out
does not reduce the error.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Plane

Mask = NDArray[np.bool_]

# Temporal error: the limits for one surface seen in two frames, and the fewest pixels to report.
_SAME_SURFACE_PX = 0.5
_SMALLEST_DISPARITY_PX = 0.5
_NEAREST_M = 0.05
_FEWEST_PIXELS = 50


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors over ``n`` pixels; all of them are NaN if n is 0."""

    n: int
    epe_px: float  # end-point error: mean absolute difference
    d1_pct: float  # share of pixels with an error above 1 px
    bad2_pct: float  # share of pixels with an error above 2 px
    d3_pct: float  # share above 3 px; KITTI's D1 also requires 5 % of the truth
    d5_pct: float  # share of pixels with an error above 5 px

    @classmethod
    def mean(cls, frames: Sequence[Self]) -> Self:
        """Average over the frames of a sequence with equal weights, without frames that lack truth.

        ``n`` is the sum over the frames.
        """
        seen = [frame for frame in frames if frame.n > 0]
        names = ("epe_px", "d1_pct", "bad2_pct", "d3_pct", "d5_pct")
        return cls(
            sum(frame.n for frame in seen),
            *(_mean(np.array([getattr(frame, name) for frame in seen])) for name in names),
        )


@dataclass(frozen=True, slots=True)
class ErrorTail:
    """The errors that only 1, 3 and 5 % of the pixels exceed.

    Stereo Matching in Time (WACV 2024) prints them as "bad 1 %, 3 %, 5 %"; its columns show that
    they are percentiles and not means.
    """

    worst_1_pct_px: float
    worst_3_pct_px: float
    worst_5_pct_px: float


@dataclass(frozen=True, slots=True)
class TemporalAccuracy:
    """Flicker over ``n`` pixels; NaN if there are too few pixels."""

    n: int
    tepe_px: float  # mean absolute error of the change in disparity along the true motion
    t1_pct: float  # share of pixels where that error exceeds 1 px


def accuracy(disparity_px: Plane, truth_px: Plane, mask: Mask | None = None) -> Accuracy:
    """Compare with the truth where it is known and ``mask`` (bool [H, W]) is true."""
    errors = _errors(disparity_px, truth_px, mask)
    return Accuracy(
        n=errors.size,
        epe_px=_mean(errors),
        d1_pct=_share_above(errors, 1),
        bad2_pct=_share_above(errors, 2),
        d3_pct=_share_above(errors, 3),
        d5_pct=_share_above(errors, 5),
    )


def error_tail(disparity_px: Plane, truth_px: Plane, mask: Mask | None = None) -> ErrorTail:
    """Return high percentiles of the error, over the pixels that :func:`accuracy` uses."""
    errors = _errors(disparity_px, truth_px, mask)
    if errors.size == 0:
        return ErrorTail(np.nan, np.nan, np.nan)
    return ErrorTail(*(float(value) for value in np.percentile(errors, (99, 97, 95))))


def temporal_epe(
    prev_px: Plane,
    curr_px: Plane,
    *,
    prev_truth_px: Plane,
    curr_truth_px: Plane,
    rig: RectifiedRig,
    curr_from_prev: Pose,
) -> TemporalAccuracy:
    """Follow each true surface point from one frame to the next and compare how disparity changed.

    All four planes are pixel offsets u_left - u_right. A point takes part if it lands inside the
    image, on the surface that the current truth shows there (within half a pixel of disparity).
    """
    height, width = prev_truth_px.shape
    zero_px = rig.offset_of_zero_disparity_px
    v, u = np.nonzero(prev_truth_px - zero_px > _SMALLEST_DISPARITY_PX)  # False for NaN
    uvd1 = np.stack([u, v, prev_truth_px[v, u], np.ones_like(u)], axis=-1, dtype=np.float64)
    xyzw = uvd1 @ rig.xyzw_from_uvd.T
    x, y, z = curr_from_prev.apply(xyzw[:, :3] / xyzw[:, 3:]).T
    ahead = z > _NEAREST_M
    z = np.where(ahead, z, 1.0)
    u_curr, v_curr = rig.fx * x / z + rig.cx_left, rig.fy * y / z + rig.cy
    inside = ahead & (u_curr >= 0) & (v_curr >= 0) & (u_curr < width - 1) & (v_curr < height - 1)
    prev = v[inside], u[inside]
    curr = np.rint(v_curr[inside]).astype(int), np.rint(u_curr[inside]).astype(int)
    expected_px = rig.fx * rig.baseline_m / z[inside] + zero_px
    same = np.abs(curr_truth_px[curr] - expected_px) < _SAME_SURFACE_PX
    change_px = _complete(curr_px)[curr] - _complete(prev_px)[prev]
    true_change_px = curr_truth_px[curr] - prev_truth_px[prev]
    errors = np.abs(change_px - true_change_px)[same].astype(np.float64)
    if errors.size <= _FEWEST_PIXELS:
        return TemporalAccuracy(errors.size, np.nan, np.nan)
    return TemporalAccuracy(errors.size, _mean(errors), _share_above(errors, 1))


def _errors(disparity_px: Plane, truth_px: Plane, mask: Mask | None) -> NDArray[np.float64]:
    known = np.isfinite(truth_px) if mask is None else np.isfinite(truth_px) & mask
    errors: NDArray[np.float32] = np.abs(_complete(disparity_px)[known] - truth_px[known])
    return errors.astype(np.float64)


def _complete(disparity_px: Plane) -> Plane:
    return np.where(np.isfinite(disparity_px), disparity_px, np.float32(0))


def _mean(errors: NDArray[np.float64]) -> float:
    return float(errors.mean()) if errors.size else float("nan")


def _share_above(errors: NDArray[np.float64], threshold_px: float) -> float:
    return 100 * _mean((errors > threshold_px).astype(np.float64))


def confidence_from_sigma(sigma_px: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the probability of an error below one pixel, times 255, of the same shape.

    The error is modelled as a Laplace distribution, whose expected absolute error is its scale,
    ``sigma_px``: 40 of 255 is a sigma of 5.9 px.
    """
    probability = 1 - np.exp(-1 / np.maximum(sigma_px, np.float32(1e-6)))
    return np.asarray(np.rint(probability * 255), np.uint8)
