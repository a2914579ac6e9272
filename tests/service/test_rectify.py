"""Rectification: what is at one point in space is on one row, at the disparity of its depth."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.frames import REACH, RIG, make_frame
from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Pose
from vergence_proto.types import Distortion, Intrinsics, PoseSample, StereoFrame, StereoRig
from vergence_service.process.threads import Cost
from vergence_service.streams.rectify import Rectifier, check_rig
from vergence_service.streams.search_window import SearchReach
from vergence_service.streams.stream import StreamConfig

WIDTH, HEIGHT = 320, 240
# Toed in, rolled a little, and not quite level.
LEFT_FROM_RIGHT = Pose.from_xyzw(
    np.array([0.01, -0.02, 0.015, 1.0]), np.array([0.1, 0.004, -0.003])
)


def camera(distortion: Distortion, coefficients: tuple[float, ...], shift: float) -> Intrinsics:
    focal = 160.0 if distortion is Distortion.KANNALA_BRANDT else 240.0
    return Intrinsics(
        WIDTH, HEIGHT, focal, focal + 2, 158.0 + shift, 121.0, distortion, coefficients
    )


RIGS = {
    "pinhole": StereoRig(
        camera(Distortion.NONE, (), 0), camera(Distortion.NONE, (), 5), LEFT_FROM_RIGHT
    ),
    "brown-conrady": StereoRig(
        camera(Distortion.BROWN_CONRADY, (-0.1, 0.02, 0.001, -0.001), 0),
        camera(Distortion.BROWN_CONRADY, (-0.12, 0.03, 0.0, 0.001, 0.001), 5),
        LEFT_FROM_RIGHT,
    ),
    "fisheye": StereoRig(
        camera(Distortion.KANNALA_BRANDT, (0.02, -0.005, 0.001, 0.0), 0),
        camera(Distortion.KANNALA_BRANDT, (0.01, -0.004, 0.0, 0.0), 5),
        LEFT_FROM_RIGHT,
    ),
}
Points = NDArray[np.float64]


def project(points_camera: Points, intrinsics: Intrinsics) -> Points:
    """Pixels [N, 2] of points [N, 3] in the camera as it is, by OpenCV's own projection."""
    nowhere = np.zeros((3, 1))
    coefficients = np.array(intrinsics.coefficients or (0.0,) * 4)[:, None]
    fisheye = intrinsics.distortion is Distortion.KANNALA_BRANDT
    points = points_camera[:, None]
    if fisheye:
        pixels, _ = cv2.fisheye.projectPoints(
            points, nowhere, nowhere, intrinsics.matrix, coefficients
        )
    else:
        pixels, _ = cv2.projectPoints(points, nowhere, nowhere, intrinsics.matrix, coefficients)
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def blob(pixel: Points) -> NDArray[np.uint8]:
    """An image that is black but for a smooth bright blob round one pixel."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    bright = 255 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / (2 * 3.0**2))
    return np.repeat(np.rint(bright).astype(np.uint8)[..., None], 3, axis=2)


def centre(image: NDArray[np.uint8]) -> Points:
    weight = image[..., 0].astype(np.float64)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.array([(weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()])


@pytest.mark.parametrize("name", list(RIGS))
def test_a_point_lands_where_the_rectified_rig_says(name: str) -> None:
    rig = RIGS[name]
    rectifier = Rectifier.of(rig, REACH)
    stated = rectifier.rig
    point_left = np.array([0.15, -0.1, 1.4])
    point_right = rig.left_from_right.inverse().apply(point_left)
    left, right = rectifier.rectify(
        blob(project(point_left[None], rig.left)[0]), blob(project(point_right[None], rig.right)[0])
    )
    x, y, z = rectifier.left_from_rectified.inverse().apply(point_left)
    expected_left = [stated.fx * x / z + stated.cx_left, stated.fy * y / z + stated.cy]
    disparity_px = stated.fx * stated.baseline_m / z
    expected_right = [
        expected_left[0] - disparity_px - stated.offset_of_zero_disparity_px,
        expected_left[1],
    ]
    # A blob's centre moves by a few hundredths of a pixel as the lens stretches it.
    np.testing.assert_allclose(centre(left), expected_left, atol=0.1)
    np.testing.assert_allclose(centre(right), expected_right, atol=0.1)
    assert stated.baseline_m == pytest.approx(np.linalg.norm(LEFT_FROM_RIGHT.translation_m))


async def test_replies_state_the_rectified_rig_its_pose_and_nothing_unseen() -> None:
    rig = RIGS["pinhole"]
    rectifier = Rectifier.of(rig, REACH)
    world_from_left = Pose.from_xyzw(np.array([0.1, 0.2, 0.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    frame = StereoFrame(1, 1, image, image, PoseSample(world_from_left))
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", StreamConfig(rig))
        answer = (
            await server.engine.step("a", lambda: frame, arrived_s=0.0, cost=Cost())
        ).disparity_map()
    assert answer.rig == rectifier.rig
    assert answer.world_from_left is not None
    expected = world_from_left @ rectifier.left_from_rectified
    np.testing.assert_allclose(answer.world_from_left.matrix, expected.matrix, atol=1e-12)
    assert rectifier.seen is not None
    assert 0 < rectifier.seen.mean() < 1
    np.testing.assert_array_equal(answer.valid, rectifier.seen)


def test_a_rig_that_is_rectified_is_left_as_it_is() -> None:
    rectifier = Rectifier.of(StereoRig.from_rectified(RIG), REACH)
    frame = make_frame(1)
    left, right = rectifier.rectify(frame.left, frame.right)
    assert rectifier.rig == RIG
    assert left is frame.left
    assert right is frame.right


def turned_around(rig: StereoRig) -> StereoRig:
    return StereoRig(rig.right, rig.left, rig.left_from_right.inverse())


def one_above_the_other(rig: StereoRig) -> StereoRig:
    return StereoRig(rig.left, rig.right, Pose(np.eye(3), np.array([0.0, 0.1, 0.0])))


def one_fisheye(rig: StereoRig) -> StereoRig:
    return StereoRig(rig.left, RIGS["fisheye"].right, rig.left_from_right)


def seen_by_nobody(rig: StereoRig) -> StereoRig:
    """The principal point is so far away that the image holds nothing of the common view."""
    left = replace(rig.left, cx=1e6)
    return StereoRig(left, rig.right, rig.left_from_right)


@pytest.mark.parametrize("refuse", [Rectifier.of, check_rig])
@pytest.mark.parametrize("spoil", [turned_around, one_above_the_other, one_fisheye, seen_by_nobody])
def test_a_rig_that_cannot_be_rectified_is_refused(
    spoil: Callable[[StereoRig], StereoRig], refuse: Callable[[StereoRig, SearchReach], object]
) -> None:
    with pytest.raises(BadCalibration, match=r"expected|no pixel"):
        refuse(spoil(RIGS["pinhole"]), REACH)


@pytest.mark.parametrize("rig", [*RIGS.values(), StereoRig.from_rectified(RIG)])
def test_a_rig_that_can_be_rectified_passes_the_check(rig: StereoRig) -> None:
    check_rig(rig, REACH)


def fisheye(focal_px: float, turn: Pose = LEFT_FROM_RIGHT) -> StereoRig:
    each = Intrinsics(
        640, 480, focal_px, focal_px, 319.5, 239.5, Distortion.KANNALA_BRANDT, (0.0,) * 4
    )
    return StereoRig(each, each, turn)


@pytest.mark.parametrize("degrees", [100, 140, 160, 179, 200, 229, 280])
def test_a_wide_fisheye_keeps_its_resolution_ahead(degrees: int) -> None:
    focal_px = 320 / np.radians(degrees / 2)
    rig = fisheye(focal_px)
    rectifier = Rectifier.of(rig, REACH)
    stated = rectifier.rig
    assert stated.fx == stated.fy
    # A pixel ahead is no larger than a quarter more, and the view is no wider than a plane shows.
    assert stated.fx >= 0.8 * min(focal_px, 320 / np.tan(np.radians(55))) - 1e-9
    assert stated.baseline_m == pytest.approx(np.linalg.norm(LEFT_FROM_RIGHT.translation_m))
    # The old and the new camera agree where a point ahead is.
    point = np.array([0.1, -0.1, 2.0])
    x, y, z = rectifier.left_from_rectified.inverse().apply(point)
    u, v = stated.fx * x / z + stated.cx_left, stated.fy * y / z + stated.cy
    maps = rectifier.maps
    assert maps is not None
    seen_at = maps[0].whole[round(v), round(u)]
    np.testing.assert_allclose(seen_at, project(point[None], rig.left)[0], atol=1.5)
    assert rectifier.seen is not None
    assert rectifier.seen[round(v), round(u)]


def test_fisheyes_that_look_apart_are_refused() -> None:
    apart = Pose.from_xyzw(np.array([0.0, 0.8, 0.0, 0.6]), np.array([0.1, 0.0, 0.0]))
    with pytest.raises(BadCalibration, match=r"one direction|no pixel"):
        Rectifier.of(fisheye(160.0, apart), REACH)


@pytest.mark.parametrize("tail", [(0.0,) * 6, (0.001, -0.001, 0.0005, 0.0, 0.01, -0.02)])
def test_twelve_and_fourteen_coefficients_bend_as_opencv_bends(tail: tuple[float, ...]) -> None:
    coefficients = (-0.1, 0.02, 0.001, -0.001, 0.0, 0.0, 0.0, 0.0, *tail)
    bent = Intrinsics(
        WIDTH, HEIGHT, 240.0, 240.0, 158.0, 121.0, Distortion.BROWN_CONRADY, coefficients
    )
    rig = StereoRig(bent, bent, LEFT_FROM_RIGHT)
    rectifier = Rectifier.of(rig, REACH)
    point = np.array([0.15, -0.1, 1.4])
    left, _ = rectifier.rectify(*[blob(project(point[None], rig.left)[0])] * 2)
    x, y, z = rectifier.left_from_rectified.inverse().apply(point)
    stated = rectifier.rig
    expected = [stated.fx * x / z + stated.cx_left, stated.fy * y / z + stated.cy]
    np.testing.assert_allclose(centre(left), expected, atol=0.15)
