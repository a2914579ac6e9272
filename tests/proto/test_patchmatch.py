"""PatchMatch finds shifts and slopes, and moves its planes with the camera."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vergence_models.foreign.textures import texture
from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev
from vergence_proto.patchmatch import UNKNOWN_SIGMA_PX, moved, patchmatch

HEIGHT, WIDTH, RANGE_PX = 96, 224, 64
INNER = (slice(16, -16), slice(60, -16))  # what both cameras see, without edges

Image = NDArray[np.uint8]


def slanted_pair(offset_px: float, right: float, down: float) -> tuple[Image, Image]:
    """A pair that shows the plane ``offset_px + right * u + down * v``."""
    wall = texture(HEIGHT, 2 * WIDTH, 3)
    v, u = np.indices((HEIGHT, WIDTH), np.float32)
    # The right view's column u_r shows the point of the left view's column u: u_r = u - d(u, v).
    seen = (u + offset_px + down * v) / (1 - right)
    other = cv2.remap(wall, np.asarray(seen, np.float32), v, cv2.INTER_CUBIC)
    return wall[:, :WIDTH], np.asarray(other, np.uint8)


@pytest.mark.parametrize(
    ("offset_px", "right", "down"),
    [
        (0, 0, 0),
        (6, 0, 0),
        (37, 0, 0),
        (10, 0.2, 0),
        (40, -0.15, 0),
        (20, 0, 0.25),
        (12, 0.1, -0.1),
    ],
    ids=["far", "near", "nearer", "a wall ahead", "the other wall", "a ceiling", "a tilted board"],
)
def test_a_plane_is_found_with_its_slopes(offset_px: float, right: float, down: float) -> None:
    found = patchmatch(*slanted_pair(offset_px, right, down), max_disparity_px=RANGE_PX)
    v, u = np.indices((HEIGHT, WIDTH))
    error = np.abs(found.disparity_px - (offset_px + right * u + down * v))[INNER]
    assert np.median(error) < 0.25
    assert np.mean(error < 1) > 0.95
    assert found.matched[INNER].mean() > 0.95
    assert np.median(found.sigma_px[INNER]) < 2  # that of a pixel without a match is 4
    middle = found.planes[1:, 8:-8, 30:-8]
    assert np.median(middle, axis=(1, 2)) == pytest.approx([right, down], abs=0.03)


def test_the_same_pair_gives_the_same_bits() -> None:
    pair = slanted_pair(12, 0.1, 0)
    one, two = (patchmatch(*pair, max_disparity_px=RANGE_PX) for _ in range(2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)


def test_what_only_the_left_camera_sees_is_not_matched() -> None:
    left, right = slanted_pair(40, 0, 0)
    found = patchmatch(left, right, max_disparity_px=RANGE_PX)
    assert found.matched[16:-16, 2:30].mean() < 0.1
    assert found.sigma_px[16:-16, 2:30].min() > 2


def test_where_nothing_can_be_matched_sigma_is_wide() -> None:
    blank = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)
    nothing = patchmatch(blank, blank, max_disparity_px=RANGE_PX)
    assert not nothing.matched.any()
    assert np.all(nothing.sigma_px == UNKNOWN_SIGMA_PX)
    assert np.isfinite(nothing.disparity_px).all()
    assert patchmatch(*noise, max_disparity_px=RANGE_PX).matched.mean() < 0.3


def test_planes_move_with_the_camera_as_the_plane_itself_does() -> None:
    rig = RectifiedRig(64, 48, 50.0, 50.0, 31.5, 31.5, 23.5, 0.1)
    turned = np.asarray(cv2.Rodrigues(np.array([0.05, -0.08, 0.03]))[0], np.float64)
    matrix = uvd_curr_from_prev(rig, Pose(turned, np.array([0.02, -0.03, -0.2])))
    v, u = np.indices((48, 64))
    plane = np.array([0.05, -0.04, -1.0, 6.0])  # (right, down, -1, offset)
    planes = np.stack(
        [plane[0] * u + plane[1] * v + 6, *np.full((2, 48, 64), plane[:2, None, None])]
    )
    found = moved(planes.astype(np.float32), matrix)
    right, down, minus_one, offset = np.linalg.inv(matrix).T @ plane
    expected = (right * u + down * v + offset) / -minus_one
    known = np.isfinite(found[0])
    assert 0.5 < known.mean() < 1
    np.testing.assert_allclose(found[0][known], expected[known], atol=1e-4)
    np.testing.assert_allclose(found[1][known], right / -minus_one, atol=1e-5)
    np.testing.assert_allclose(found[2][known], down / -minus_one, atol=1e-5)


def test_where_two_surfaces_arrive_the_nearer_one_is_seen() -> None:
    planes = np.zeros((3, 8, 32), np.float32)
    planes[0] = 2
    planes[0, :, 20:24] = 10
    mirrored = np.array([[1, 0, -1, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    found = moved(planes, mirrored)[0]
    assert np.all(found[:, 10:14] == 10)
    assert np.all(found[:, :10] == 2)
    assert np.isnan(found[:, 18:22]).all()  # behind the board, seen from there


def test_one_iteration_from_moved_planes_is_better_than_one_from_guesses() -> None:
    before = slanted_pair(12, 0.1, 0)
    start = patchmatch(*before, max_disparity_px=RANGE_PX).planes
    nearer = np.eye(4, dtype=np.float32)
    nearer[2, 3] = 9  # a change of the two principal points: all disparities grow
    pair = slanted_pair(21, 0.1, 0)
    truth = 21 + 0.1 * np.arange(WIDTH)

    def error_px(
        previous: NDArray[np.float32] | None, matrix: NDArray[np.float32] | None = None
    ) -> float:
        found = patchmatch(
            *pair,
            max_disparity_px=RANGE_PX,
            iterations=1,
            previous=previous,
            uvd_curr_from_prev=matrix,
        )
        return float(np.abs(found.disparity_px - truth)[INNER].mean())

    cold, still, warm = error_px(None), error_px(start), error_px(start, nearer)
    assert warm < 0.2
    assert warm < 0.8 * min(cold, still)
