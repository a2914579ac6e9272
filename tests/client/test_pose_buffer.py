"""Poses of a tracker, and the clock of the frames."""

import time
from collections.abc import AsyncIterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence import BadPose, BadShape, DepthClient, NotSent, Pose, PoseSample
from vergence.pose_buffer import PoseBuffer

MS = 1_000_000
AT_REST = Pose.identity()


def turned(angle: float, x_m: float = 0.0) -> Pose:
    """A turn about the vertical axis, and a way to the right."""
    half = angle / 2
    return Pose.from_xyzw(np.array([0, np.sin(half), 0, np.cos(half)]), np.array([x_m, 0, 0]))


def buffer(*poses: tuple[int, Pose], left: Pose | None = None, offset_s: float = 0.0) -> PoseBuffer:
    made = PoseBuffer(left, offset_s)
    for at_ms, pose in poses:
        made.add(at_ms * MS, PoseSample(pose))
    return made


@settings(max_examples=50, deadline=None)
@given(angle=st.floats(-3, 3), share=st.floats(0, 1), x_m=st.floats(-1, 1))
def test_a_steady_motion_is_interpolated_exactly(angle: float, share: float, x_m: float) -> None:
    seen = buffer((0, turned(0)), (100, turned(angle, x_m))).at(round(share * 100 * MS))
    exact = turned(angle * share, x_m * share)
    np.testing.assert_allclose(seen.world_from_left.matrix, exact.matrix, atol=1e-6)


def test_the_frame_has_the_pose_of_its_own_time_and_of_its_camera() -> None:
    left = Pose(np.eye(3), np.array([0.03, 0, 0]))
    poses = buffer((0, turned(0)), (50, turned(0.5)), (100, turned(1.0)), left=left, offset_s=0.02)
    seen = poses.at(30 * MS).world_from_left  # 50 ms on the tracker's clock
    np.testing.assert_allclose(seen.matrix, (turned(0.5) @ left).matrix, atol=1e-9)


@pytest.mark.parametrize(
    ("at_ms", "why"),
    [(-1, "1.0 ms before the earliest"), (101, "1.0 ms after the latest"), (400, "gap of 600 ms")],
)
def test_a_frame_without_poses_around_it_is_refused_with_the_reason(at_ms: int, why: str) -> None:
    poses = buffer((0, AT_REST), (100, AT_REST))
    if "gap" in why:
        poses.add(700 * MS, PoseSample(AT_REST))
    with pytest.raises(BadPose, match=why):
        poses.at(at_ms * MS)


def test_poses_come_in_the_order_of_time_and_what_one_lacks_is_not_valid() -> None:
    poses = buffer((10, AT_REST))
    with pytest.raises(BadPose, match=r"5\.0 ms before the latest"):
        poses.add(5 * MS, PoseSample(AT_REST))
    with pytest.raises(BadPose, match="finite"):
        poses.add(20 * MS, PoseSample(Pose(np.eye(3), np.full(3, np.nan))))
    poses.add(20 * MS, PoseSample(AT_REST, position_valid=False, tracked=False))
    sample = poses.at(15 * MS)
    assert (sample.orientation_valid, sample.position_valid, sample.tracked) == (True, False, False)


def test_the_buffer_forgets_what_is_long_ago() -> None:
    poses = PoseBuffer(None, 0.0)
    for at_ms in range(20_000):
        poses.add(at_ms * MS, PoseSample(AT_REST))
    assert poses.at(19_990 * MS)
    with pytest.raises(BadPose, match="before the earliest"):
        poses.at(0)


@pytest.fixture
async def client() -> AsyncIterator[DepthClient]:
    async with (
        running_server(RecallModel()) as server,
        DepthClient(server.grpc_address) as client,
    ):
        yield client


async def test_a_session_interpolates_poses_and_lives_on_after_one_that_is_missing(
    client: DepthClient,
) -> None:
    frame = make_frame(1)
    now_ns = time.monotonic_ns()
    async with client.open_session(RIG) as session:
        session.track(now_ns, turned(0))
        session.track(now_ns + 40 * MS, turned(0.2).matrix)
        with pytest.raises(BadPose, match="after the latest"):
            session.submit(frame.left, frame.right, capture_ns=now_ns + 41 * MS)
        assert session.submit(frame.left, frame.right, capture_ns=now_ns + 20 * MS)
        result = await anext(session)
        assert result.world_from_left is not None
        np.testing.assert_allclose(result.world_from_left.matrix, turned(0.1).matrix, atol=1e-6)


async def test_a_session_has_one_clock_and_refuses_what_is_impossible_on_it(
    client: DepthClient,
) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG, clock=time.time_ns) as session:
        with pytest.raises(BadShape, match=r"years before its now"):
            session.submit(frame.left, frame.right, capture_ns=time.monotonic_ns())
        with pytest.raises(BadShape, match=r"hours after its now"):
            session.submit(frame.left, frame.right, capture_ns=time.time_ns() + 7_300 * 10**9)
        captured_ns = time.time_ns()
        assert session.submit(frame.left, frame.right, frame.pose, capture_ns=captured_ns)
        result = await anext(session)
        assert 0 < result.age_s < 60
        assert session.depth_at(AT_REST, max_age_s=60) is not None
        assert session.submit(frame.left, frame.right, frame.pose) is not NotSent.CREDIT
        assert (await anext(session)).capture_ns > captured_ns


async def test_a_live_session_whose_clock_changes_refuses_the_other_clock(
    client: DepthClient,
) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG) as session:
        assert session.submit(frame.left, frame.right, capture_ns=time.monotonic_ns())
        assert 0 <= (await anext(session)).age_s < 60
        with pytest.raises(BadShape, match=r"years after its now; state the clock .* as clock="):
            session.submit(frame.left, frame.right, capture_ns=time.time_ns())
        assert session.submit(frame.left, frame.right, capture_ns=time.monotonic_ns())
        assert 0 <= (await anext(session)).age_s < 60
