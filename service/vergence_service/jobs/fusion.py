"""Fuse maps of one frame whose errors differ."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vergence_proto.accuracy import confidence_from_sigma
from vergence_proto.types import DisparityMap

# Maps that are farther apart than this see two surfaces: their mean would be on neither.
_SAME_SURFACE_PX = 2.0
_LEAST_SIGMA_PX = 0.05  # of the weights: no map may decide alone


def fused(disparity: DisparityMap, others: Sequence[DisparityMap]) -> DisparityMap:
    """Return a map with the weighted means of all maps that agree, the rest as in ``disparity``.

    Each pixel takes the maps near the surest one, or near the median if there are three, weighted
    by 1 / sigma squared. Errors of one network are alike, so sigma is the mean of theirs and not
    smaller. Every map has a sigma.
    """
    if not others:
        return disparity
    maps = [disparity, *others]
    px = np.stack([each.disparity_px for each in maps])
    sigma_px = np.stack([np.asarray(each.sigma_px, np.float32) for each in maps])
    known = np.isfinite(px)
    weights = np.where(known, 1 / np.maximum(sigma_px, np.float32(_LEAST_SIGMA_PX)) ** 2, 0)
    weights = weights.astype(np.float32)
    reference = _reference(px, weights, known)
    with np.errstate(invalid="ignore"):
        weights[~(np.abs(px - reference) <= _SAME_SURFACE_PX)] = 0
    total = weights.sum(axis=0)
    anywhere = total > 0
    total[~anywhere] = 1
    weights /= total
    mean_px = (np.where(known, px, 0) * weights).sum(axis=0, dtype=np.float32)
    mean_px[~anywhere] = np.nan
    mean_sigma_px = (sigma_px * weights).sum(axis=0, dtype=np.float32)
    mean_sigma_px[~anywhere] = np.asarray(disparity.sigma_px, np.float32)[~anywhere]
    confidence = disparity.confidence
    if confidence is not None:
        confidence = confidence_from_sigma(mean_sigma_px)
        confidence[~anywhere] = 0
    return dataclasses.replace(
        disparity, disparity_px=mean_px, sigma_px=mean_sigma_px, confidence=confidence
    )


def _reference(
    px: NDArray[np.float32], weights: NDArray[np.float32], known: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the disparity [H, W] near which maps [N, H, W] count."""
    surest: NDArray[np.float32] = np.take_along_axis(px, weights.argmax(axis=0)[None], axis=0)[0]
    if len(px) < 3:
        return surest
    middle: NDArray[np.float32] = np.sort(px, axis=0)[len(px) // 2]  # NaN comes last
    return np.where(known.all(axis=0), middle, surest)
