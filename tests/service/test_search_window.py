"""The images that the model sees: its search starts at zero disparity and reaches a fair share."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vergence_proto.geometry import RectifiedRig
from vergence_service.streams.search_window import SearchReach, SearchWindow

WIDTH, HEIGHT = 400, 4
RIG = RectifiedRig(WIDTH, HEIGHT, 300.0, 300.0, 199.5, 199.5, 1.5, 0.1)
FIXED = SearchReach(max_disparity_px=192, min_width_share=0.0)
SHARED = SearchReach(max_disparity_px=192, min_width_share=0.15)
Image = NDArray[np.uint8]


def stroke(column: int, width: int = WIDTH) -> Image:
    image = np.zeros((HEIGHT, width, 3), np.uint8)
    image[:, column] = 255
    return image


@given(st.floats(-150, 150), st.integers(0, 150))
def test_a_point_is_found_at_its_disparity_wherever_the_principal_points_are(
    apart_px: float, disparity_px: int
) -> None:
    rig = replace(RIG, cx_right=RIG.cx_left - apart_px)
    window = SearchWindow.of(rig, FIXED)
    zero_px = rig.offset_of_zero_disparity_px
    column = 390 if apart_px > 0 else 160
    right_column = round(column - disparity_px - zero_px)
    if not 0 <= right_column < WIDTH - 1:
        return
    left, right = window.images(stroke(column), stroke(right_column))
    # A match inside the image stays inside it.
    at_left, at_right = (int(np.flatnonzero(image[0, :, 0])[0]) for image in (left, right))
    assert at_left == column + window.left_shift_px
    # The images move by whole pixels; a stroke has no fractions.
    assert -0.5 <= at_left - at_right - disparity_px <= 1.5
    answer = np.full(left.shape[:2], at_left - at_right, np.float32)
    found = window.disparity_px(answer, HEIGHT, WIDTH)
    assert found.shape == (HEIGHT, WIDTH)
    if disparity_px > 1:
        np.testing.assert_allclose(found, disparity_px, atol=0.51)


@given(st.floats(-300, 300))
def test_the_search_starts_within_a_pixel_of_zero_disparity(apart_px: float) -> None:
    rig = replace(RIG, cx_right=RIG.cx_left - apart_px)
    window = SearchWindow.of(rig, FIXED)
    assert 0 <= window.rig.offset_of_zero_disparity_px < 1
    assert 191 < window.max_disparity_px <= 192


def test_cameras_with_one_principal_point_are_shown_as_they_are() -> None:
    window = SearchWindow.of(RIG, SHARED)
    left, right = stroke(30), stroke(20)
    assert window.images(left, right)[0] is left
    assert window.images(left, right)[1] is right
    assert window.rig == RIG
    assert window.max_disparity_px == 192


@pytest.mark.parametrize(("width", "reduction"), [(640, 1), (1280, 1), (1920, 2), (3839, 3)])
def test_the_range_is_at_least_its_share_of_the_width(width: int, reduction: int) -> None:
    rig = replace(RIG, width=width, cx_left=width / 2 + 7, cx_right=width / 2)
    window = SearchWindow.of(rig, SHARED)
    assert window.reduction == reduction
    assert window.max_disparity_px == pytest.approx(192 * reduction, abs=1)
    assert window.max_disparity_px >= 0.15 * width - 1
    left, _ = window.images(stroke(width - 1, width), stroke(0, width))
    assert left.shape == (window.rig.height, window.rig.width, 3)
    # A pixel of the model and the same direction in the rig.
    u, v, d = 100.0, 1.0, 11.0
    seen = np.array([*(((p + 0.5) / reduction) - 0.5 for p in (u, v))])
    zero_px, zero_seen_px = rig.offset_of_zero_disparity_px, window.rig.offset_of_zero_disparity_px
    offset_seen = d / reduction + zero_seen_px
    whole = rig.xyzw_from_uvd @ [u, v, d + zero_px, 1]
    small = window.rig.xyzw_from_uvd @ [*seen, offset_seen, 1]
    np.testing.assert_allclose(small[:3] / small[3], whole[:3] / whole[3])
    answer = np.full(left.shape[:2], offset_seen, np.float32)
    found = window.disparity_px(answer, HEIGHT, width)
    np.testing.assert_allclose(found, np.full((HEIGHT, width), d), rtol=1e-5)
    sigma = window.sigma_px(np.ones(left.shape[:2], np.float32), HEIGHT, width)
    np.testing.assert_array_equal(sigma, np.full((HEIGHT, width), reduction))


def test_beyond_the_range_and_behind_infinity_there_is_no_value() -> None:
    window = SearchWindow.of(RIG, FIXED)
    answer = np.array([[-0.5, 0.0, 0.1, 192.0, 192.1, 230.0]], np.float32)
    found = window.disparity_px(answer, 1, 6)
    assert np.isnan(found).tolist() == [[True, True, False, False, True, True]]
