"""Filters leave out values, and change nothing else."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from vergence import BadShape, DepthResult, keep_confident, keep_range, without_speckles
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Plane

RIG = RectifiedRig(12, 9, 400, 400, 5.5, 5.5, 4, 0.1)
PLANES = arrays.arrays(
    np.float32,
    (9, 12),
    elements=st.one_of(st.floats(0.125, 60, width=32), st.just(float("nan"))),
)
CONFIDENCES = arrays.arrays(np.uint8, (9, 12))


def result_of(disparity_px: Plane) -> DepthResult:
    return DepthResult(frame_id=1, capture_ns=5, rig=RIG, disparity_px=disparity_px)


def assert_kept(before: DepthResult, after: DepthResult, kept: object) -> None:
    """Where ``kept`` is true the values are the same, elsewhere there are none."""
    expected = np.where(np.asarray(kept), before.disparity_px, np.float32(np.nan))
    np.testing.assert_array_equal(after.disparity_px, expected)
    assert after.disparity_px.dtype == np.float32
    for field in fields(DepthResult):
        if field.name != "disparity_px":
            assert getattr(after, field.name) is getattr(before, field.name)


@given(PLANES, CONFIDENCES, st.integers(0, 255))
def test_confidence(disparity_px: Plane, confidence: NDArray[np.uint8], least: int) -> None:
    result = replace(result_of(disparity_px), confidence=confidence)
    assert_kept(result, keep_confident(result, least), confidence >= least)


def test_confidence_must_have_been_requested() -> None:
    with pytest.raises(BadShape, match=r"OutputFormat\(confidence=True\)"):
        keep_confident(result_of(np.ones((9, 12), np.float32)), 128)


@given(PLANES, st.floats(0, 50), st.floats(0, 50))
def test_range(disparity_px: Plane, near_m: float, far_m: float) -> None:
    result = result_of(disparity_px)
    with np.errstate(invalid="ignore"):
        depth_m = 40 / disparity_px
        kept = (depth_m >= near_m) & (depth_m <= far_m)
    unclear = np.abs(depth_m - near_m) + np.abs(depth_m - far_m) < 1e-5
    after = keep_range(result, near_m, far_m)
    assert_kept(result, after, kept | (unclear & after.valid))
    assert_kept(result, keep_range(result), result.valid)


@given(arrays.arrays(np.uint8, (9, 12), elements=st.integers(0, 3)), st.integers(0, 20))
def test_a_region_of_at_most_so_many_pixels_is_a_speckle(levels: Plane, largest: int) -> None:
    """Levels lie far apart, so that a region is a connected set of one level."""
    result = result_of(np.where(levels > 0, 10 * levels, np.nan).astype(np.float32))
    kept = np.zeros(levels.shape, np.bool_)
    for level in (1, 2, 3):
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            (levels == level).astype(np.uint8), connectivity=4
        )
        for label in range(1, count):
            kept |= (labels == label) & (stats[label, cv2.CC_STAT_AREA] > largest)
    assert_kept(result, without_speckles(result, largest), kept)


def test_neighbours_that_differ_little_are_one_region() -> None:
    slope = np.tile(np.arange(12, dtype=np.float32) * 0.9 + 3, (9, 1))
    result = result_of(slope)
    assert_kept(result, without_speckles(result, 50), True)
    assert not without_speckles(result, 50, max_step_px=0.5).valid.any()


@given(PLANES)
def test_tiny_and_huge_disparities_are_values(disparity_px: Plane) -> None:
    wide = np.where(disparity_px > 30, disparity_px * 1000, disparity_px / 1000)
    result = result_of(wide.astype(np.float32))
    assert_kept(result, without_speckles(result, 0), result.valid)
