"""A stream's life as its clients see it: a place, a token, an expiry, an end."""

import asyncio

import pytest

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.server import ManualClock, running_server
from tests.support.session_frames import step, submit
from vergence import (
    DepthClient,
    DepthSession,
    EventKind,
    Origin,
    SessionEvent,
    StreamExpired,
    StreamLimit,
    Superseded,
    UnknownStream,
)
from vergence_proto.instruction_set import instruction_set


async def test_waiting_in_vain_for_a_place_says_how_long_to_wait() -> None:
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG),
    ):
        with pytest.raises(StreamLimit) as refused:
            async with client.open_session(RIG, open_timeout_s=0.1):
                pass
        assert refused.value.retry_after_s is not None
        assert refused.value.retry_after_s > 0


async def test_the_server_describes_itself_and_its_streams(
    client: DepthClient, model: RecallModel
) -> None:
    async with client.open_session(RIG, stream_id="hall") as session:
        await step(session, 1)
        server, stream = await client.server_info(), await client.stream_info("hall")
        assert session.model == server.model
    assert server.model.name == model.card.name
    assert (server.engine, server.provider) == (model.engine, model.provider)
    assert server.instruction_set == instruction_set()
    assert server.streams_open == 1
    assert (stream.attached, stream.frames_stepped, stream.step_count) == (True, 1, 1)


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


async def test_a_stream_can_be_closed_by_somebody_else(client: DepthClient) -> None:
    async with client.open_session(RIG, stream_id="left-open") as session:
        await step(session, 1)
        await client.close_stream("left-open")
        assert (await client.server_info()).streams_open == 0
        with pytest.raises(UnknownStream):
            await step(session, 2)


async def test_leaving_the_session_frees_the_stream(client: DepthClient) -> None:
    async with client.open_session(RIG) as session:
        await step(session, 1)
    assert (await client.server_info()).streams_open == 0
    with pytest.raises(RuntimeError, match="has ended"):
        await step(session, 2)


async def test_an_idle_stream_expires_after_a_notice() -> None:
    clock = ManualClock()
    events: list[SessionEvent] = []
    async with (
        running_server(RecallModel(), clock=clock) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, on_event=events.append, on_lost="raise") as session,
    ):
        clock.advance(55)
        await eventually(lambda: events)
        clock.advance(10)
        with pytest.raises(StreamExpired):
            await anext(session)
    assert [event.kind for event in events] == [EventKind.EXPIRING]
    assert 0 < events[0].in_s <= 10


async def test_an_end_that_meets_what_the_client_sends_is_reported_as_what_it_is() -> None:
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
            async with client.open_session(RIG, on_event=events.append, on_lost="raise") as session:
                sending = asyncio.create_task(send_without_pause(session))
                await step(session, 1)
                clock.advance(60)
                server.engine.streams.sweep()
                with pytest.raises(StreamExpired):
                    await anext(session)
                with pytest.raises(StreamExpired):
                    await sending
    assert not events, "the client took the end for a broken connection, and tried again"
