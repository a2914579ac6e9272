"""Mistakes of a program raise an error of the project's own, at the call that makes them."""

import gc
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.support.frames import RIG, make_frame
from tests.support.server_process import recall_server
from tests.support.strategies import POSES, RIGS
from vergence import (
    BadCalibration,
    BadPose,
    BlockingClient,
    BlockingSession,
    DepthClient,
    DepthSession,
    NotOpen,
    Pose,
    RectifiedRig,
    StereoRig,
)
from vergence_proto import codec

FRAME = make_frame(1)
NOT_POSITIVE = st.one_of(st.floats(max_value=0.0), st.sampled_from([math.nan, math.inf]))


async def test_a_client_outside_async_with_says_how_to_open_it() -> None:
    client = DepthClient("grpc://127.0.0.1:1")
    for call in (
        client.server_info,
        lambda: client.stream_info("a"),
        lambda: client.close_stream("a"),
    ):
        with pytest.raises(NotOpen, match=r"async with DepthClient\('grpc://127\.0\.0\.1:1'\)"):
            await call()
    with pytest.raises(NotOpen):
        client.open_session(RIG)


async def test_a_client_after_async_with_is_not_open() -> None:
    async with DepthClient("grpc://127.0.0.1:1") as client:
        pass
    with pytest.raises(NotOpen):
        await client.server_info()


@pytest.mark.parametrize(
    "use",
    [
        lambda session: session.submit(FRAME.left, FRAME.right),
        lambda session: session.reset(),
        lambda session: session.end(),
        lambda session: session.rig,
        lambda session: session.model,
        lambda session: session.credit,
        lambda session: session.resume_token,
    ],
    ids=["submit", "reset", "end", "rig", "model", "credit", "resume_token"],
)
async def test_a_session_before_async_with_says_how_to_open_it(
    client: DepthClient, use: Callable[[DepthSession], object]
) -> None:
    session = client.open_session(RIG)
    with pytest.raises(NotOpen, match=r"async with client\.open_session\(rig\)"):
        use(session)
    assert session.drops.total == 0


async def test_a_session_before_async_with_neither_steps_nor_iterates(client: DepthClient) -> None:
    session = client.open_session(RIG)
    with pytest.raises(NotOpen):
        await session.step(FRAME.left, FRAME.right)
    with pytest.raises(NotOpen):
        await anext(session)


async def test_a_session_opens_once_and_takes_no_frame_after_its_end(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await session.step(FRAME.left, FRAME.right)
    with pytest.raises(NotOpen, match="open a new one"):
        session.submit(FRAME.left, FRAME.right)
    with pytest.raises(NotOpen, match="open_session"):
        await session.__aenter__()


async def test_a_session_that_is_forgotten_open_warns(client: DepthClient) -> None:
    async def open_and_forget() -> None:
        await client.open_session(RIG, stream_id="forgotten").__aenter__()
        gc.collect()

    with pytest.warns(ResourceWarning, match="'forgotten' was not closed"):
        await open_and_forget()


async def test_a_session_that_was_left_or_never_opened_does_not_warn(client: DepthClient) -> None:
    client.open_session(RIG)
    async with client.open_session(RIG) as session:
        await session.step(FRAME.left, FRAME.right)
    del session
    gc.collect()  # any warning would be an error here


def test_a_blocking_client_outside_with_says_how_to_open_it() -> None:
    client = BlockingClient("grpc://127.0.0.1:1")
    with pytest.raises(NotOpen, match=r"with BlockingClient\(server\)"):
        client.server_info()
    with pytest.raises(NotOpen):
        client.open_session(RIG)


def test_a_blocking_session_before_with_is_not_open() -> None:
    with recall_server() as server, BlockingClient(server) as client:
        session = client.open_session(RIG)
        with pytest.raises(NotOpen):
            session.submit(FRAME.left, FRAME.right)
        with pytest.raises(NotOpen):
            session.step(FRAME.left, FRAME.right)
        with pytest.raises(NotOpen):
            _ = session.rig


@pytest.mark.parametrize(
    ("blocking", "asynchronous"),
    [(BlockingClient, DepthClient), (BlockingSession, DepthSession)],
    ids=["client", "session"],
)
def test_blocking_methods_take_the_same_arguments(blocking: type, asynchronous: type) -> None:
    for name, method in inspect.getmembers(asynchronous, inspect.isfunction):
        if not name.startswith("_"):
            parameters = inspect.signature(getattr(blocking, name)).parameters
            assert parameters == inspect.signature(method).parameters, name


@given(POSES)
def test_every_pose_survives_as_a_matrix(pose: Pose) -> None:
    for matrix in (pose.matrix, pose.matrix[:3]):
        np.testing.assert_array_equal(Pose.from_matrix(matrix).matrix, pose.matrix)


@pytest.mark.parametrize(
    "matrix",
    [np.eye(3), np.eye(4)[None], np.zeros(16), np.eye(4)[:2], "pose", [[1.0], [1.0, 2.0]], None],
    ids=["3x3", "stack", "flat", "2x4", "text", "ragged", "none"],
)
def test_a_matrix_of_another_shape_is_no_pose(matrix: Any) -> None:
    with pytest.raises(BadPose, match=r"expected a .*matrix"):
        Pose.from_matrix(matrix)


@given(POSES)
def test_a_transposed_matrix_is_no_pose(pose: Pose) -> None:
    assume(np.abs(pose.translation_m).max() > 0.01)
    with pytest.raises(BadPose, match="last row"):
        Pose.from_matrix(pose.matrix.T)


@given(POSES, st.floats(0.0, 10.0).filter(lambda scale: abs(scale - 1) > 0.01))
def test_a_scaled_rotation_is_not_sent(pose: Pose, scale: float) -> None:
    with pytest.raises(BadPose, match="orthonormal"):
        codec.pose_to_proto(Pose(pose.rotation * scale, pose.translation_m))
    matrix = pose.matrix
    matrix[:3, :3] *= scale
    with pytest.raises(BadPose, match="orthonormal"):
        Pose.from_matrix(matrix)


@given(POSES, st.sampled_from([math.nan, math.inf]), st.integers(0, 2), st.integers(0, 3))
async def test_a_number_that_is_not_finite_is_not_sent(
    pose: Pose, number: float, row: int, column: int
) -> None:
    matrix = pose.matrix
    matrix[row, column] = number
    with np.errstate(invalid="ignore"), pytest.raises(BadPose):
        Pose.from_matrix(matrix)


@pytest.mark.parametrize(
    ("orientation_xyzw", "translation_m"),
    [([0, 0, 0, 0], [0, 0, 0]), ([0, 0, 1], [0, 0, 0]), ([0, 0, 0, 1], [0, math.nan, 0])],
    ids=["zero", "three", "nan"],
)
def test_a_quaternion_that_is_none_is_no_pose(orientation_xyzw: Any, translation_m: Any) -> None:
    with pytest.raises(BadPose, match="expected a"):
        Pose.from_xyzw(orientation_xyzw, translation_m)


@given(RIGS)
def test_every_rig_is_accepted_and_survives(rig: RectifiedRig) -> None:
    assert StereoRig.from_rectified(rig).left.fx == rig.fx


@pytest.mark.parametrize("field", ["width", "height", "fx", "fy", "baseline_m"])
@given(rig=RIGS, value=NOT_POSITIVE)
def test_a_rectified_rig_with_a_length_that_is_not_positive_is_refused(
    field: str, rig: RectifiedRig, value: float
) -> None:
    assume(not (field in ("width", "height") and value == math.inf))
    values = {name: getattr(rig, name) for name in RectifiedRig.__dataclass_fields__}
    with pytest.raises(BadCalibration, match=r"must be (a )?positive"):
        RectifiedRig(**{**values, field: value})


@pytest.mark.parametrize("field", ["cx_left", "cx_right", "cy"])
@given(rig=RIGS, value=st.sampled_from([math.nan, math.inf, -math.inf]))
def test_a_principal_point_must_be_finite(field: str, rig: RectifiedRig, value: float) -> None:
    values = {name: getattr(rig, name) for name in RectifiedRig.__dataclass_fields__}
    with pytest.raises(BadCalibration, match="principal points"):
        RectifiedRig(**{**values, field: value})


@given(POSES, st.floats(0.0, 10.0).filter(lambda scale: abs(scale - 1) > 0.01))
def test_cameras_that_are_not_rigidly_joined_are_no_rig(pose: Pose, scale: float) -> None:
    rig = StereoRig.from_rectified(RIG)
    with pytest.raises(BadCalibration, match="left_from_right"):
        StereoRig(rig.left, rig.right, Pose(pose.rotation * scale, pose.translation_m))
