"""A session against the real server, in one process, with a model small enough to know by heart."""

import asyncio
from collections.abc import AsyncIterator

import numpy as np
import pytest

from tests.client.waiting import eventually
from tests.support.frames import FRAME_NS, RIG, make_frame
from tests.support.models import RAISES, RecallModel
from tests.support.server import ManualClock, running_server
from vergence import (
    Axes,
    BadPose,
    BadShape,
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    EventKind,
    FrameStale,
    ImageEncoding,
    ModelFailed,
    Origin,
    OutputFormat,
    PlaneEncoding,
    Pose,
    PoseSample,
    SessionEvent,
    StreamExists,
    StreamExpired,
    StreamLimit,
    Superseded,
    UnknownStream,
)
from vergence_service.app import Running

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)


@pytest.fixture
def model() -> RecallModel:
    return RecallModel()


@pytest.fixture
async def server(model: RecallModel) -> AsyncIterator[Running]:
    async with running_server(model) as server:
        yield server


@pytest.fixture
async def client(server: Running) -> AsyncIterator[DepthClient]:
    async with DepthClient(server.grpc_address) as client:
        yield client


async def step(session: DepthSession, frame_id: int, brightness: int = 64) -> DepthResult:
    frame = make_frame(frame_id, brightness=brightness)
    return await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


def submit(session: DepthSession, frame_id: int, brightness: int = 64) -> int | None:
    frame = make_frame(frame_id, brightness=brightness)
    return session.submit(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


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


async def test_live_results_come_by_iteration_until_the_end(client: DepthClient) -> None:
    seen = []
    async with client.open_session(RIG) as session:
        submit(session, 1)
        async for result in session:
            seen.append(result.frame_id)
            if result.frame_id == 5:
                session.end()
            else:
                submit(session, result.frame_id + 1)
    assert seen == [1, 2, 3, 4, 5]
    assert session.drops.total == 0


async def test_frames_beyond_the_credit_are_dropped_at_the_source_and_counted(
    client: DepthClient, model: RecallModel
) -> None:
    async with client.open_session(RIG) as session:
        assert session.credit == 2
        with model.busy():
            taken = [submit(session, frame_id) for frame_id in range(1, 11)]
            assert taken == [1, 2] + [None] * 8
            assert session.drops.at_source == 8
        first, second = [await anext(session) for _ in range(2)]
        assert (first.frame_id, second.frame_id) == (1, 2)
        assert submit(session, 11) == 3  # ids have no gap: what is not sent has none
        assert (await anext(session)).drops.total == 8


async def test_a_newer_frame_displaces_one_that_waits_and_every_frame_is_accounted_for(
    model: RecallModel,
) -> None:
    async with (
        running_server(model, grpc__credit=5) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG) as session,
    ):
        with model.busy():
            submit(session, 1)
            await asyncio.to_thread(model.wait_until_entered)
            for frame_id in (2, 3, 4, 5, 6):
                submit(session, frame_id)
            await eventually(lambda: session.drops.displaced == 3)
        results = [await anext(session) for _ in range(2)]
    assert [result.frame_id for result in results] == [1, 5]
    assert (session.drops.at_source, session.drops.displaced) == (1, 3)
    assert results[1].frames_skipped == 3


async def test_a_slow_reader_gets_the_newest_results(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        for frame_id in (1, 3, 5, 7, 9):
            submit(session, frame_id)
            await step(session, frame_id + 1)  # answered after what was sent before it
        session.end()
        assert [result.frame_id async for result in session] == [7, 9]
    assert session.drops.unread == 3


async def test_overlapping_steps_go_out_in_order_and_none_is_lost(client: DepthClient) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        results = await asyncio.gather(*(step(session, frame_id) for frame_id in range(1, 21)))
    assert [result.step_count for result in results] == list(range(1, 21))
    assert session.drops.total == 0


async def test_a_lossless_session_does_not_take_frames_that_it_might_drop(
    client: DepthClient,
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        with pytest.raises(RuntimeError, match=r"use step\(\)"):
            submit(session, 1)


async def test_a_stale_frame_is_counted_and_its_step_raises(
    client: DepthClient, model: RecallModel
) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG) as session:
        with model.busy():
            submit(session, 1)
            await asyncio.to_thread(model.wait_until_entered)
            session.submit(frame.left, frame.right, max_age_s=0.0)
        assert (await anext(session)).frame_id == 1
        await step(session, 2)
        assert session.drops.stale == 1


async def test_a_step_that_is_displaced_raises_frame_stale(
    model: RecallModel,
) -> None:
    async with (
        running_server(model, grpc__credit=3) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG) as session,
    ):
        with model.busy():
            submit(session, 1)
            await asyncio.to_thread(model.wait_until_entered)
            displaced = asyncio.create_task(step(session, 2))
            await asyncio.sleep(0)
            submit(session, 3)
            with pytest.raises(FrameStale, match="displaced"):
                await displaced


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


@pytest.mark.parametrize("server", ["ftp://host:80", "host", ":50051", "grpc://", "host:port"])
def test_a_server_that_is_none_is_refused_by_its_spelling(server: str) -> None:
    with pytest.raises(ValueError, match=r"grpc://HOST:PORT"):
        DepthClient(server)


async def test_waiting_in_vain_for_a_place_says_how_long_to_wait() -> None:
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG),
    ):
        with pytest.raises(StreamLimit) as refused:
            async with client.open_session(RIG):
                pass
        assert refused.value.retry_after_s is not None
        assert refused.value.retry_after_s > 0


async def test_a_reset_starts_the_next_frame_from_nothing(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
        session.reset()
        again = await step(session, 2)
    assert (again.origin, again.step_count) == (Origin.RESET_REQUESTED, 1)


async def test_whoever_has_the_token_takes_the_stream_over(client: DepthClient) -> None:
    async with client.open_session(RIG, stream_id="shared") as old:
        await step(old, 1)
        async with client.open_session(
            RIG, stream_id="shared", resume_token=old.resume_token
        ) as new:
            with pytest.raises(Superseded):
                await anext(old)
            with pytest.raises(Superseded):
                submit(old, 2)
            result = await step(new, 2)
    assert (result.frame_id, result.origin, result.step_count) == (2, Origin.RESUMED, 2)


async def test_an_idle_stream_expires_after_a_notice() -> None:
    clock = ManualClock()
    events: list[SessionEvent] = []
    async with (
        running_server(RecallModel(), clock=clock) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, on_event=events.append) as session,
    ):
        clock.advance(55)
        await eventually(lambda: events)
        clock.advance(10)
        with pytest.raises(StreamExpired):
            await anext(session)
    assert [event.kind for event in events] == [EventKind.EXPIRING]
    assert 0 < events[0].in_s <= 10


async def test_an_end_that_meets_what_the_client_sends_is_told_as_what_it_is() -> None:
    async def send_without_pause(session: DepthSession) -> None:
        while True:
            session.reset()
            await asyncio.sleep(0)

    clock = ManualClock()
    events: list[SessionEvent] = []
    async with (
        running_server(RecallModel(), clock=clock) as server,
        DepthClient(server.grpc_address) as client,
    ):
        for _ in range(10):  # the two meet in about every second
            async with client.open_session(RIG, on_event=events.append) as session:
                sending = asyncio.create_task(send_without_pause(session))
                await step(session, 1)
                clock.advance(60)
                server.engine.streams.sweep()
                with pytest.raises(StreamExpired):
                    await anext(session)
                with pytest.raises(StreamExpired):
                    await sending
    assert not events, "the client took the end for a broken connection, and tried again"


async def test_pings_measure_the_round_trip(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
        assert session.round_trip_s is not None
        assert 0 <= session.round_trip_s < 5


async def test_the_server_tells_about_itself_and_its_streams(
    client: DepthClient, model: RecallModel
) -> None:
    async with client.open_session(RIG, stream_id="hall") as session:
        await step(session, 1)
        server, stream = await client.server_info(), await client.stream_info("hall")
        assert session.model == server.model
    assert server.model.name == model.card.name
    assert server.streams_open == 1
    assert (stream.attached, stream.frames_stepped, stream.step_count) == (True, 1, 1)


async def test_leaving_the_session_frees_the_stream(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
    assert (await client.server_info()).streams_open == 0
    with pytest.raises(RuntimeError, match="has ended"):
        await step(session, 2)


async def test_a_stream_can_be_closed_by_somebody_else(client: DepthClient) -> None:
    async with client.open_session(RIG, stream_id="left-open") as session:
        await step(session, 1)
        await client.close_stream("left-open")
        assert (await client.server_info()).streams_open == 0
        with pytest.raises(UnknownStream):
            await step(session, 2)


async def test_every_submitted_frame_is_accounted_for(client: DepthClient) -> None:
    async def film(session: DepthSession) -> None:
        for frame_id in range(1, 101):
            submit(session, frame_id, brightness=RAISES if frame_id % 10 == 0 else 64)
            await asyncio.sleep(0.001 * (frame_id % 3))
        session.end()

    results = errors = 0
    async with client.open_session(RIG) as session:
        camera = asyncio.create_task(film(session))
        while True:
            try:
                await anext(session)
                results += 1
            except ModelFailed:
                errors += 1
            except StopAsyncIteration:
                break
        await camera
    assert results > 0
    assert results + errors + session.drops.total == 100
