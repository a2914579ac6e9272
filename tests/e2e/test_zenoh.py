"""Over Zenoh, the SDK and the server give the same answers as over gRPC, by the same rules."""

import asyncio
from contextlib import suppress

import numpy as np
import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.zenoh_net import address_of, free_endpoint, router
from tests.support.zenoh_sessions import LOSSLESS, lone_server, server_on, step, submit
from vergence import (
    ConnectionLost,
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    FrameTooLarge,
    ImageEncoding,
    OutputFormat,
    PlaneEncoding,
    StreamExists,
    StreamLimit,
    Superseded,
    UnknownStream,
    depth,
)
from vergence_service.app.server import Running

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32, sigma=True, confidence=True)


def held(server: Running) -> list[str]:
    """Which of the streams a and b this server has."""
    found = []
    for stream_id in ("a", "b"):
        with suppress(UnknownStream):
            found.append(server.engine.streams.get(stream_id).stream_id)
    return found


@pytest.mark.parametrize("delivery", Delivery, ids=lambda delivery: delivery.name)
async def test_a_sequence_is_answered_alike_over_grpc_and_zenoh(delivery: Delivery) -> None:
    async def walk(address: str) -> list[DepthResult]:
        async with (
            DepthClient(address) as client,
            client.open_session(
                RIG, delivery=delivery, output=EXACT, encoding=ImageEncoding.RAW
            ) as session,
        ):
            return [await step(session, frame_id) for frame_id in range(1, 11)]

    async with lone_server() as (server, address):
        over_grpc = await walk(server.grpc_address)
        over_zenoh = await walk(address)
    for one, other in zip(over_grpc, over_zenoh, strict=True):
        np.testing.assert_array_equal(one.disparity_px, other.disparity_px)
        np.testing.assert_array_equal(one.sigma_px, other.sigma_px)
        np.testing.assert_array_equal(one.confidence, other.confidence)
        assert (one.origin, one.step_count, one.capture_ns) == (
            other.origin,
            other.step_count,
            other.capture_ns,
        )


async def until_displaced(session: DepthSession, count: int) -> None:
    await eventually(lambda: session.drops.displaced == count)


async def test_a_newer_frame_displaces_one_that_waits() -> None:
    model = RecallModel()
    async with (
        lone_server(model, streams__credit=5) as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG, link="fixed") as session,
    ):
        with model.busy():
            submit(session, 1)
            await asyncio.to_thread(model.wait_until_entered)
            submit(session, 2)
            # One frame at a time is on its way: Zenoh may drop frames of a burst.
            for displaced, frame_id in enumerate((3, 4, 5), start=1):
                submit(session, frame_id)
                await until_displaced(session, displaced)
        results = [await anext(session) for _ in range(2)]
    assert [result.frame_id for result in results] == [1, 5]
    assert results[1].frames_skipped == 3


async def test_every_frame_of_a_burst_is_accounted_for() -> None:
    model = RecallModel()
    async with (
        lone_server(model, streams__credit=5) as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG, link="fixed") as session,
    ):
        with model.busy():
            submit(session, 1)
            await asyncio.to_thread(model.wait_until_entered)
            for frame_id in (2, 3, 4, 5, 6):
                submit(session, frame_id)
            # The server displaced the frame, or Zenoh dropped it on a busy machine.
            await until_displaced(session, 3)
        first, second = [(await anext(session)).frame_id for _ in range(2)]
    assert (session.drops.at_source, session.drops.displaced, session.drops.total) == (1, 3, 4)
    assert first == 1
    assert 2 <= second <= 5


async def test_streams_go_to_the_server_with_the_most_room_and_stay_there() -> None:
    async with (
        router() as between,
        server_on(between.endpoint, streams__capacity=1) as one,
        server_on(between.endpoint, streams__capacity=1) as other,
        DepthClient(between.address) as client,
        client.open_session(RIG, stream_id="a") as a,
        client.open_session(RIG, stream_id="b") as b,
    ):
        for frame_id in (1, 2, 3):
            assert (await step(a, frame_id)).step_count == frame_id
        await step(b, 1)
        assert sorted(held(one) + held(other)) == ["a", "b"]
        assert len(held(one)) == len(held(other)) == 1
        assert (await client.stream_info("a")).frames_stepped == 3
        with pytest.raises(StreamExists):
            await client.open_session(RIG, stream_id="a").__aenter__()
        with pytest.raises(StreamLimit):
            await client.open_session(RIG, stream_id="c", open_timeout_s=0.1).__aenter__()
        await client.close_stream("b")
        with pytest.raises(UnknownStream):
            await step(b, 2)
        async with client.open_session(RIG, stream_id="c") as c:
            await step(c, 1)


async def test_the_newest_attachment_has_the_stream() -> None:
    async with (
        lone_server() as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG, stream_id="shared") as old,
    ):
        await step(old, 1)
        async with (
            DepthClient(address) as another,
            another.open_session(RIG, stream_id="shared", resume_token=old.resume_token) as new,
        ):
            with pytest.raises(Superseded):
                await anext(old)
            assert (await step(new, 2)).step_count == 2


async def test_a_reset_lies_between_the_frames_it_was_sent_between() -> None:
    async with (
        lone_server() as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG, delivery=LOSSLESS) as session,
    ):
        steps = [asyncio.create_task(step(session, 1)), asyncio.create_task(step(session, 2))]
        await asyncio.sleep(0)
        session.reset()
        results = [*await asyncio.gather(*steps), await step(session, 3)]
    assert [result.step_count for result in results] == [1, 2, 1]


async def test_a_frame_over_the_limit_is_refused_and_the_stream_lives_on() -> None:
    big = np.zeros((480, 640, 3), np.uint8)
    async with (
        lone_server(limits__max_frame_mib=1) as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG, encoding=ImageEncoding.RAW) as session,
    ):
        with pytest.raises(FrameTooLarge, match="1048576"):
            await session.step(big, big)
        assert (await step(session, 2)).step_count == 1


def test_the_blocking_facade_takes_the_same_addresses() -> None:
    async def serve_and_ask() -> DepthResult:
        async with lone_server() as (_, address):
            frame = make_frame(1)
            return await asyncio.to_thread(depth, frame.left, frame.right, RIG, server=address)

    assert asyncio.run(serve_and_ask()).step_count == 1


async def test_without_a_server_the_client_says_what_it_looked_for() -> None:
    async with router() as between, DepthClient(f"{between.address}/lab") as client:
        with pytest.raises(ConnectionLost, match="no server answers in namespace 'lab'"):
            await client.server_info()
    nowhere = address_of(free_endpoint())
    async with DepthClient(nowhere) as client:
        with pytest.raises(ConnectionLost, match="no connection"):
            await client.server_info()


async def test_namespaces_do_not_meet() -> None:
    async with (
        router() as between,
        server_on(between.endpoint, zenoh__namespace="lab/left", streams__capacity=3),
        server_on(between.endpoint, zenoh__namespace="lab/right", streams__capacity=7),
        DepthClient(f"{between.address}/lab/right") as client,
    ):
        assert (await client.server_info()).streams_max == 7
