"""The figures of one frame: its errors, their change along the motion, and its own uncertainty.

The definitions are :mod:`vergence_proto.accuracy`'s, under the short names that tables use.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vergence_proto.accuracy import accuracy, error_tail, temporal_epe
from vergence_proto.geometry import Pose, RectifiedRig

Plane = NDArray[np.float32]

MIN_PIXELS = 20  # a frame with fewer known pixels has no figures
SIGMAS = (1, 2, 3)
SHARES_PCT = range(10, 100, 10)  # the intervals in which the calibration of sigma is measured


def error_measures(predicted_px: Plane, truth_px: Plane) -> dict[str, float] | None:
    """EPE in px; D1, bad2, D3, D5 in percent; the errors at the 95th, 97th and 99th percentile.

    ``truth_px`` is NaN where unknown; None if hardly anything is known. The percentiles are what
    Stereo Matching in Time (WACV 2024) tabulates as bad 5, 3 and 1 %.
    """
    found = accuracy(predicted_px, truth_px)
    if found.n < MIN_PIXELS:
        return None
    tail = error_tail(predicted_px, truth_px)
    return {
        "epe": found.epe_px,
        "d1": found.d1_pct,
        "bad2": found.bad2_pct,
        "d3": found.d3_pct,
        "d5": found.d5_pct,
        "p95": tail.worst_5_pct_px,
        "p97": tail.worst_3_pct_px,
        "p99": tail.worst_1_pct_px,
    }


def calibration(predicted_px: Plane, sigma_px: Plane, truth_px: Plane) -> dict[str, float] | None:
    """The calibration of sigma.

    Returns the shares of errors, in percent, within 1, 2 and 3 sigma (of a Laplace distribution of
    that scale 63, 86 and 95 %), within its 10 % to 90 % intervals, and the ratio of the means.
    """
    known = np.isfinite(truth_px)
    if known.sum() < MIN_PIXELS:
        return None
    error = np.abs(predicted_px[known] - truth_px[known])
    sigma = sigma_px[known]
    relative = error / np.maximum(sigma, 1e-6)
    within = {
        f"within_{share}": 100 * float((relative < -math.log(1 - share / 100)).mean())
        for share in SHARES_PCT
    }
    within |= {
        f"within_{sigmas}_sigma": 100 * float((relative < sigmas).mean()) for sigmas in SIGMAS
    }
    return {**within, "sigma_over_error": float(sigma.mean() / max(error.mean(), 1e-6))}


def temporal_error(
    rig: RectifiedRig,
    curr_from_prev: Pose,
    predicted_px: tuple[Plane, Plane],
    truth_px: tuple[Plane, Plane],
) -> float | None:
    """Flicker: the mean error in px of the change of disparity from the previous frame to this.

    Both pairs are (previous, current). None if hardly any surface point is seen in both.
    """
    found = temporal_epe(
        *predicted_px,
        prev_truth_px=truth_px[0],
        curr_truth_px=truth_px[1],
        rig=rig,
        curr_from_prev=curr_from_prev,
    )
    return None if math.isnan(found.tepe_px) else found.tepe_px
