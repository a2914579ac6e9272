"""A session against the real server, in one process, with a model small enough to know by heart."""

import numpy as np
import pytest

from tests.support.frames import FRAME_NS, RIG, make_frame
from tests.support.models import RAISES
from tests.support.polling import eventually
from tests.support.session_frames import EXACT, step, submit
from vergence import (
    Axes,
    BadPose,
    BadShape,
    DepthClient,
    ImageEncoding,
    ModelFailed,
    Origin,
    OutputFormat,
    PlaneEncoding,
    Pose,
    PoseSample,
    StreamExists,
    UnknownStream,
)


async def test_steps_build_on_each_other(client: DepthClient) -> None:
    async with client.open_session(RIG, output=EXACT) as session:
        first, second = [await step(session, frame_id) for frame_id in (1, 2)]
    assert (first.origin, second.origin) == (Origin.COLD_START, Origin.WARM)
    assert (first.step_count, second.step_count) == (1, 2)
    assert (first.frame_id, second.frame_id) == (1, 2)
    assert second.capture_ns == 2 * FRAME_NS
    assert (second.disparity_px > first.disparity_px).all()


async def test_a_result_carries_depth_in_metres_and_the_pose_that_was_used(
    client: DepthClient,
) -> None:
    output = OutputFormat(encoding=PlaneEncoding.FLOAT32, confidence=True, sigma=True)
    async with client.open_session(RIG, output=output) as session:
        result = await step(session, 3)
        assert session.rig == RIG
    np.testing.assert_allclose(result.depth_m, RIG.fx * RIG.baseline_m / result.disparity_px)
    assert result.valid.all()
    assert result.sigma_px is not None
    assert result.confidence is not None
    assert result.world_from_left is not None
    np.testing.assert_allclose(result.world_from_left.translation_m, [0.03, 0, 0])
    assert result.timings.total_s >= result.timings.model_s > 0


async def test_the_age_counts_from_the_capture(client: DepthClient) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG) as session:
        fresh = await session.step(frame.left, frame.right)
        old = await session.step(frame.left, frame.right, capture_ns=fresh.capture_ns - 10**9)
    assert fresh.age_s >= fresh.timings.total_s
    assert old.age_s > 1 + fresh.timings.model_s


@pytest.mark.parametrize("axes", Axes, ids=lambda axes: axes.name)
async def test_poses_come_back_in_the_axes_they_were_sent_in(
    client: DepthClient, axes: Axes
) -> None:
    angle = np.pi / 6
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    sent = Pose(turn, np.array([1.0, 2.0, 3.0]))
    frame = make_frame(1)
    async with client.open_session(RIG, axes=axes) as session:
        result = await session.step(frame.left, frame.right, sent)
    assert result.world_from_left is not None
    np.testing.assert_allclose(result.world_from_left.matrix, sent.matrix, atol=1e-12)


async def test_poses_may_be_matrices_samples_or_missing(client: DepthClient) -> None:
    frame = make_frame(1)
    pose = Pose(np.eye(3), np.array([0.01, 0.0, 0.0]))
    async with client.open_session(RIG) as session:
        for given in (pose, PoseSample(pose), pose.matrix, pose.matrix[:3]):
            result = await session.step(frame.left, frame.right, given)
            assert result.world_from_left is not None
            np.testing.assert_array_equal(result.world_from_left.matrix, pose.matrix)
        without = await session.step(frame.left, frame.right)
    assert without.world_from_left is None
    assert without.origin is Origin.RESET_POSE_LOST


@pytest.mark.parametrize("encoding", [ImageEncoding.RAW, ImageEncoding.PNG])
async def test_grey_images_are_as_good_as_colour_with_equal_channels(
    client: DepthClient, encoding: ImageEncoding
) -> None:
    frame = make_frame(1)
    left, right = frame.left[..., 0], frame.right[..., 0]
    async with client.open_session(RIG, output=EXACT, encoding=encoding) as session:
        grey = await session.step(left, right)
        session.reset()
        colour = await session.step(np.dstack([left] * 3), np.dstack([right] * 3))
    np.testing.assert_array_equal(grey.disparity_px, colour.disparity_px)


async def test_the_trouble_of_one_frame_is_raised_for_it_and_the_stream_lives_on(
    client: DepthClient,
) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
        with pytest.raises(ModelFailed):
            await step(session, 2, brightness=RAISES)
        after = await step(session, 3)
        assert (after.origin, after.step_count) == (Origin.WARM, 2)
        submit(session, 4, brightness=RAISES)
        with pytest.raises(ModelFailed):
            await anext(session)
        submit(session, 5)
        assert (await anext(session)).step_count == 3


async def test_errors_of_the_server_arrive_as_the_same_class(client: DepthClient) -> None:
    small = np.zeros((8, 8), np.uint8)
    async with client.open_session(RIG, stream_id="mine") as session:
        with pytest.raises(BadShape, match="64x48"):
            await session.step(small, small)
        with pytest.raises(StreamExists, match="mine"):
            async with client.open_session(RIG, stream_id="mine"):
                pass
    with pytest.raises(UnknownStream, match="nobody"):
        await client.stream_info("nobody")


async def test_what_no_server_would_take_is_refused_before_it_is_sent(client: DepthClient) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG) as session:
        with pytest.raises(BadPose):
            session.submit(frame.left, frame.right, Pose(np.eye(3), np.full(3, np.nan)))
        assert submit(session, 2) == 1
    for stream_id in ("", "a/b", "bäd", "x" * 129):
        with pytest.raises(BadShape, match="1 to 128"):
            client.open_session(RIG, stream_id=stream_id)


async def test_a_reset_starts_the_next_frame_from_nothing(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
        session.reset()
        again = await step(session, 2)
    assert (again.origin, again.step_count) == (Origin.RESET_REQUESTED, 1)


async def test_pings_measure_the_round_trip(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await eventually(lambda: session.round_trip_s is not None)
        assert session.round_trip_s is not None
        assert 0 <= session.round_trip_s < 5
