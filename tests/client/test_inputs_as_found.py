"""Poses, rigs and times as people have them: read as what they are, or refused with a reason."""

import logging
import math
import time
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given

from tests.support.frames import RIG, make_frame
from tests.support.strategies import POSES
from vergence import (
    BadCalibration,
    BadPose,
    BadShape,
    Delivery,
    DepthClient,
    Distortion,
    Intrinsics,
    Pose,
    PoseSample,
    RectifiedRig,
    StereoRig,
)

FRAME = make_frame(1)
CAMERA = Intrinsics(640, 480, 400.0, 400.0, 319.5, 239.5)


@given(POSES)
def test_lists_and_columns_are_the_same_pose(pose: Pose) -> None:
    column = pose.translation_m[:, None]
    for same in (
        Pose(pose.rotation.tolist(), pose.translation_m.tolist()),
        Pose(pose.rotation.astype(np.float32).astype(np.float64), column),
        Pose(pose.rotation, column.T),
        Pose.from_matrix(pose.matrix.tolist()),
        Pose.from_matrix(np.hstack([pose.rotation, column])),
        PoseSample(pose.matrix).world_from_left,  # type: ignore[arg-type]
    ):
        np.testing.assert_allclose(same.matrix, pose.matrix, rtol=1e-6, atol=1e-6)
    turned = Pose.from_xyzw(pose.orientation_xyzw[:, None], column)
    np.testing.assert_allclose(turned.matrix, pose.matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("rotation", "translation_m"),
    [
        (np.zeros(3), np.zeros(3)),  # an axis times an angle
        (np.array([0, 0, 0, 1.0]), np.zeros(3)),
        (np.eye(4), np.zeros(3)),
        (np.eye(3), np.zeros((3, 3))),
        (np.eye(3), "here"),
        (np.eye(3), None),
    ],
    ids=["rodrigues", "quaternion", "4x4", "3x3 translation", "text", "none"],
)
def test_other_shapes_are_no_pose(rotation: Any, translation_m: Any) -> None:
    with pytest.raises(BadPose, match=r"expected a (rotation|translation)"):
        Pose(rotation, translation_m)


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.eye(3), "Pose.from_xyzw"),
        (np.eye(4).ravel(), "Pose.from_xyzw"),
        (np.arange(7.0), "Pose.from_xyzw"),
        (Pose(np.eye(3), [0.3, 0.0, 0.5]).matrix.T, "transposed"),  # type: ignore[arg-type]
        (np.full((4, 4), math.nan), "without a pose"),
        ("here", "numbers"),
    ],
    ids=["3x3", "flat", "seven", "column-major", "nan", "text"],
)
async def test_a_session_says_what_is_wrong_with_a_pose(
    pose: Any, says: str, client: DepthClient
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        with pytest.raises(BadPose, match=says):
            await session.step(FRAME.left, FRAME.right, pose)
        as_lists = np.eye(4).tolist()
        answer = await session.step(FRAME.left, FRAME.right, as_lists)
        assert answer.world_from_left is not None


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_coefficients_are_taken_as_opencv_returns_them(count: int) -> None:
    returned = np.linspace(0.01, 0.001, count)[None]
    camera = Intrinsics(
        640,
        480,
        400.0,
        400.0,
        319.5,
        239.5,
        Distortion.BROWN_CONRADY,
        returned,  # type: ignore[arg-type]
    )
    assert camera.coefficients == tuple(returned[0].tolist())


@pytest.mark.parametrize("coefficients", [(0.1,) * 7, (0.1,) * 15, ("k1",), None, ((1,), (1, 2))])
def test_other_coefficients_are_refused(coefficients: Any) -> None:
    with pytest.raises(BadCalibration):
        Intrinsics(640, 480, 400.0, 400.0, 319.5, 239.5, Distortion.BROWN_CONRADY, coefficients)


def test_a_rig_takes_what_stereo_calibrate_returns() -> None:
    r = cv2.Rodrigues(np.array([0.01, 0.02, 0.03]))[0]
    t = np.array([[-0.1], [0.001], [0.002]])  # right_from_left, [3, 1]
    rig = StereoRig(CAMERA, CAMERA, Pose(np.asarray(r), t).inverse())
    assert rig.left_from_right.translation_m.shape == (3,)
    matrix = rig.left_from_right.matrix
    same = StereoRig(CAMERA, CAMERA, matrix)  # type: ignore[arg-type]
    np.testing.assert_array_equal(same.left_from_right.matrix, matrix)
    with pytest.raises(BadCalibration, match="transposed"):
        StereoRig(CAMERA, CAMERA, matrix.T)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "capture_ns", [1403636579.7635555, 1.5, "now", 2**63, math.nan, np.float64(3)], ids=repr
)
async def test_a_time_that_is_no_whole_number_is_reported(
    capture_ns: Any, client: DepthClient
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        with pytest.raises(BadShape, match="nanoseconds"):
            await session.step(FRAME.left, FRAME.right, capture_ns=capture_ns)


async def test_an_age_is_stated_only_where_it_can_be_one(
    client: DepthClient, caplog: pytest.LogCaptureFixture
) -> None:
    async def age_s(capture_ns: Any) -> float:
        async with client.open_session(RIG) as session:
            for k in range(2):
                result = await session.step(
                    FRAME.left, FRAME.right, capture_ns=capture_ns + k * 33_000_000
                )
        return result.age_s

    assert -1 < await age_s(time.monotonic_ns()) < 60
    assert not caplog.records
    for other in (time.time_ns(), 0, np.int64(1403636579763555584)):
        caplog.clear()
        assert math.isnan(await age_s(other))
        (record,) = caplog.records  # once, and not for each frame
        assert "time.monotonic_ns()" in record.message


async def test_a_recording_has_times_of_its_own(
    client: DepthClient, caplog: pytest.LogCaptureFixture
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        result = await session.step(FRAME.left, FRAME.right, capture_ns=1403636579763555584)
    assert math.isnan(result.age_s)
    assert not caplog.records


@pytest.mark.parametrize("per_second", [1_000, 1_000_000])
async def test_times_of_another_unit_are_reported_once(
    per_second: int, client: DepthClient, caplog: pytest.LogCaptureFixture
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        for k in range(4):
            capture = 1_700_000_000 * per_second + k * per_second // 30
            await session.step(FRAME.left, FRAME.right, capture_ns=capture)
    (record,) = caplog.records
    assert "is capture_ns in nanoseconds?" in record.message


async def test_a_baseline_in_millimetres_is_reported(
    client: DepthClient, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    for baseline_m, warned in ((0.1, False), (9.9, False), (100.0, True)):
        rig = RectifiedRig(640, 480, 400, 400, 320, 320, 240, baseline_m)
        for each in (rig, StereoRig.from_rectified(rig)):
            caplog.clear()
            client.open_session(each)
            assert [("millimetres" in record.message) for record in caplog.records] == [
                True
            ] * warned
