"""Errors of disparity: per pixel, along the motion, and of its own uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vergence_proto.geometry import Pose, RectifiedRig

Plane = NDArray[np.float32]

MIN_PIXELS = 20  # fewer known pixels say nothing about a frame


def error_measures(predicted_px: Plane, truth_px: Plane) -> dict[str, float] | None:
    """EPE in px; D1, bad2, D3, D5 in percent; the errors at the 95th, 97th and 99th percentile.

    ``truth_px`` is NaN where unknown; None if hardly anything is known. The percentiles are what
    Stereo Matching in Time (WACV 2024) tabulates as bad 5, 3 and 1 %.
    """
    known = np.isfinite(truth_px)
    if known.sum() < MIN_PIXELS:
        return None
    error = np.abs(predicted_px[known] - truth_px[known])
    shares = {"d1": 1, "bad2": 2, "d3": 3, "d5": 5}
    return {
        "epe": float(error.mean()),
        **{name: 100 * float((error > limit).mean()) for name, limit in shares.items()},
        **{f"p{rank}": float(np.percentile(error, rank)) for rank in (95, 97, 99)},
    }


def calibration(predicted_px: Plane, sigma_px: Plane, truth_px: Plane) -> dict[str, float] | None:
    """How far sigma says what the error is.

    The shares of errors, in percent, within the 50 % and 90 % intervals of a Laplace distribution
    of scale sigma, and the ratio of the means.
    """
    known = np.isfinite(truth_px)
    if known.sum() < MIN_PIXELS:
        return None
    error = np.abs(predicted_px[known] - truth_px[known])
    sigma = sigma_px[known]
    return {
        "within_50": 100 * float((error < sigma * np.log(2)).mean()),
        "within_90": 100 * float((error < sigma * np.log(10)).mean()),
        "sigma_over_error": float(sigma.mean() / max(error.mean(), 1e-6)),
    }


def temporal_error(
    rig: RectifiedRig,
    curr_from_prev: Pose,
    predicted_px: tuple[Plane, Plane],
    truth_px: tuple[Plane, Plane],
) -> float | None:
    """Flicker: the mean error in px of the change of disparity from the previous frame to this.

    True surface points of the previous frame are carried to the current one by the true motion;
    those seen there again (their true disparity agrees within half a pixel) are compared. None if
    there are hardly any. Both pairs are (previous, current).
    """
    before, now = truth_px
    height, width = before.shape
    v, u = np.nonzero(np.isfinite(before) & (before > 0.5))
    d = before[v, u].astype(np.float64)
    uvd = np.stack((u, v, d + 0.0, np.ones_like(d)))
    q = rig.xyzw_from_uvd
    x, y, z, w = np.linalg.inv(q) @ curr_from_prev.matrix @ q @ uvd
    ahead = w > 1e-9
    w = np.where(ahead, w, 1.0)
    column, row, expected = np.rint(x / w), np.rint(y / w), z / w
    inside = ahead & (expected > 0) & (column >= 0) & (row >= 0)
    inside &= (column < width) & (row < height)
    column, row = column[inside].astype(int), row[inside].astype(int)
    u, v, expected = u[inside], v[inside], expected[inside]
    seen = np.abs(now[row, column] - expected) < 0.5
    if seen.sum() < MIN_PIXELS:
        return None
    row, column, u, v = row[seen], column[seen], u[seen], v[seen]
    change = predicted_px[1][row, column] - predicted_px[0][v, u]
    return float(np.abs(change - (now[row, column] - before[v, u])).mean())
