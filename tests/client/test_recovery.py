"""Only the server ends a session: silence, restarts, refusals and changes, and what is reported."""

import asyncio
import threading
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually, eventually_true
from tests.support.proxy import proxy_to
from tests.support.scene import Scene, scene
from tests.support.server import ManualClock, running_server
from tests.support.session_frames import step, submit
from tests.support.sockets import free_port
from vergence import (
    ConnectionLost,
    Delivery,
    DepthClient,
    DepthSession,
    Draining,
    EventKind,
    ModelChanged,
    NotSent,
    Origin,
    SessionState,
    StreamExpired,
    StreamLimit,
    UnknownStream,
)
from vergence_service.app.server import drain


class OtherWeights(RecallModel):
    card = replace(RecallModel.card, weights_sha256="1" * 64)


async def test_the_first_attachment_is_tried_until_the_server_is_there() -> None:
    async with scene() as rough:
        rough.proxy.cut()
        opening = asyncio.create_task(rough.open_session().__aenter__())
        await asyncio.sleep(0.2)
        assert not opening.done()
        rough.proxy.mend()
        session = await opening
        assert session.state is SessionState.LIVE
        await session.__aexit__(None, None, None)


async def test_a_server_that_loads_its_model_is_waited_for() -> None:
    loaded = threading.Event()

    class Loading(RecallModel):
        def warm_up(self, iterations: int, *cold_iterations: int) -> None:
            assert loaded.wait(timeout=20)

    port = free_port()
    async with AsyncExitStack() as stack, DepthClient(f"grpc://127.0.0.1:{port}") as client:
        server = running_server(Loading(), grpc__port=port)
        starting = asyncio.create_task(stack.enter_async_context(server))

        async def listens() -> bool:
            with suppress(ConnectionLost):
                return bool(await client.server_info())
            return False

        opening = asyncio.create_task(client.open_session(RIG).__aenter__())
        await eventually_true(listens)
        assert not opening.done()
        loaded.set()
        session = await opening
        assert (await step(session, 1)).step_count == 1
        await session.__aexit__(None, None, None)
        await starting


async def test_a_server_that_cannot_be_reached_is_named_after_the_timeout() -> None:
    async with proxy_to("127.0.0.1:1") as proxy, DepthClient(proxy.address) as client:
        proxy.cut()
        with pytest.raises(ConnectionLost, match=proxy.address):
            await client.server_info()
        with pytest.raises(ConnectionLost, match=proxy.address):
            async with client.open_session(RIG, open_timeout_s=0.3):
                pass


async def test_silence_is_reported_and_nothing_is_lost_when_it_ends() -> None:
    async with scene() as rough, rough.open_session() as session:
        before = await step(session, 1)
        rough.proxy.fall_silent()
        await rough.until(EventKind.STALLED)
        assert session.state is SessionState.STALLED
        assert submit(session, 2) is NotSent.OFFLINE
        rough.proxy.mend()
        await eventually(lambda: session.state is SessionState.LIVE)
        after = await step(session, 2)
    assert (after.step_count, session.drops.offline) == (before.step_count + 1, 1)
    assert rough.kinds[0] is EventKind.STALLED
    assert EventKind.RESTARTED not in rough.kinds


@pytest.mark.parametrize("delivery", Delivery, ids=lambda delivery: delivery.value)
async def test_a_connection_that_is_dead_without_knowing_it_is_replaced(delivery: Delivery) -> None:
    async with scene() as rough, rough.open_session(delivery) as session:
        await step(session, 1)
        rough.proxy.forget_connections()  # as when a headset changes its network
        result = await step(session, 2)
        await eventually(lambda: session.state is SessionState.LIVE)
    assert (result.origin, result.step_count) == (Origin.RESUMED, 2)
    assert rough.kinds == [EventKind.STALLED, EventKind.RESUMED]


async def restarted(session: DepthSession, frame_id: int) -> None:
    """The session goes on with a cold start, and its frame ids go on."""
    result = await step(session, frame_id)
    assert (result.origin, result.step_count) == (Origin.COLD_START, 1)
    assert result.frame_id == frame_id
    assert (await step(session, frame_id + 1)).origin is Origin.WARM


async def test_a_session_outlives_a_server_that_has_forgotten_it() -> None:
    async with running_server(RecallModel()) as second, scene() as rough:
        async with rough.open_session() as session:
            await step(session, 1)
            token = session.resume_token
            rough.proxy.lead_to(second.grpc_address)
            await restarted(session, 2)
            assert session.resume_token != token
            assert rough.kinds == [EventKind.DISCONNECTED, EventKind.RESTARTED]
            assert "memory is lost: no open stream" in rough.events[1].message
        assert len(second.engine.streams) == 0


async def test_steps_that_wait_while_the_server_is_replaced_are_answered_in_order() -> None:
    async with (
        running_server(RecallModel()) as second,
        scene() as rough,
        rough.open_session(Delivery.EVERY) as session,
    ):
        await step(session, 1)
        rough.proxy.hold_upward()
        steps = [asyncio.create_task(step(session, frame_id)) for frame_id in (2, 3, 4)]
        await asyncio.sleep(0.05)
        rough.proxy.lead_to(second.grpc_address)
        results = await asyncio.gather(*steps)
    assert [result.frame_id for result in results] == [2, 3, 4]
    assert [result.step_count for result in results] == [1, 2, 3]


async def test_a_session_outlives_a_stream_that_expired() -> None:
    clock = ManualClock()
    async with scene(clock=clock) as rough, rough.open_session() as session:
        await step(session, 1)
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        clock.advance(100)
        rough.proxy.mend()
        await restarted(session, 2)
        clock.advance(100)  # now it expires while it is attached
        await eventually(lambda: rough.kinds.count(EventKind.RESTARTED) == 2)
        await restarted(session, 4)


async def test_a_session_outlives_a_server_that_shuts_down() -> None:
    async with (
        running_server(RecallModel()) as first,
        running_server(RecallModel()) as second,
        proxy_to(first.grpc_address) as proxy,
        DepthClient(proxy.address) as client,
        client.open_session(RIG) as session,
    ):
        await step(session, 1)
        draining = asyncio.create_task(drain(first, within_s=0.1))
        await eventually(lambda: session.state is SessionState.RECONNECTING)
        proxy.lead_to(second.grpc_address)
        await restarted(session, 2)
        await draining


async def test_other_weights_are_a_cold_start() -> None:
    async with (
        running_server(OtherWeights()) as second,
        scene() as rough,
        rough.open_session() as session,
    ):
        await step(session, 1)
        rough.proxy.lead_to(second.grpc_address)
        await restarted(session, 2)
        assert session.model.weights_sha256 == OtherWeights.card.weights_sha256
    assert "this one runs recall with 1111" in rough.events[1].message


async def test_other_weights_end_a_session_that_asked_for_its_own() -> None:
    async with (
        running_server(OtherWeights()) as second,
        scene() as rough,
        rough.open_session(weights_sha256=RecallModel.card.weights_sha256) as session,
    ):
        await step(session, 1)
        rough.proxy.lead_to(second.grpc_address)
        with pytest.raises(ModelChanged, match="expected a server with weights 0000"):
            await step(session, 2)


async def test_a_session_may_ask_for_the_weights_that_its_results_come_from() -> None:
    wanted = OtherWeights.card.weights_sha256
    async with running_server(RecallModel()) as server, DepthClient(server.grpc_address) as client:
        with pytest.raises(ModelChanged, match="this one runs recall with 0000"):
            async with client.open_session(RIG, weights_sha256=wanted):
                pass
        assert (await client.server_info()).streams_open == 0
    async with (
        running_server(OtherWeights()) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, weights_sha256=wanted) as session,
    ):
        assert (await step(session, 1)).step_count == 1
        assert session.model.weights_sha256 == wanted


async def test_a_session_that_must_not_restart_raises_what_the_server_says() -> None:
    clock = ManualClock()
    async with running_server(RecallModel()) as second, scene(clock=clock) as rough:
        async with rough.open_session(on_lost="raise", stream_id="expires") as session:
            await step(session, 1)
            rough.proxy.cut()
            await rough.until(EventKind.DISCONNECTED)
            clock.advance(100)
            rough.proxy.mend()
            with pytest.raises(StreamExpired):
                await step(session, 2)
        async with rough.open_session(on_lost="raise", stream_id="forgotten") as session:
            await step(session, 1)
            rough.proxy.lead_to(second.grpc_address)
            with pytest.raises(UnknownStream):
                await step(session, 2)
            with pytest.raises(UnknownStream):
                submit(session, 3)
        async with rough.open_session(on_lost="raise", stream_id="drained") as session:
            draining = asyncio.create_task(drain(second, within_s=0.1))
            with pytest.raises(Draining):
                await anext(session)
            await draining


async def test_a_session_that_must_not_restart_gives_up_when_no_server_can_have_its_stream() -> (
    None
):
    async with (
        scene(streams__detach_grace_s=0.2, streams__idle_timeout_s=0.3) as rough,
        rough.open_session(on_lost="raise") as session,
    ):
        rough.proxy.cut()
        with pytest.raises(ConnectionLost, match=r"again in 0\.5 s"):
            await anext(session)


async def test_a_server_without_room_is_waited_for() -> None:
    async with scene(streams__capacity=1) as rough, AsyncExitStack() as stack:
        first = await stack.enter_async_context(rough.client.open_session(RIG))
        with pytest.raises(StreamLimit, match="1 open streams"):
            async with rough.open_session(open_timeout_s=0.5):
                pass
        assert set(rough.kinds) == {EventKind.WAITING}
        assert all(event.in_s > 0 for event in rough.events)
        opening = asyncio.create_task(rough.open_session(open_timeout_s=2.0).__aenter__())
        await eventually(lambda: len(rough.events) > 3)
        await first.__aexit__(None, None, None)
        session = await opening
        await session.__aexit__(None, None, None)


async def test_sessions_that_end_with_a_frame_in_flight_end_without_an_error() -> None:
    frame = make_frame(1)
    async with running_server(RecallModel(), streams__capacity=100) as server:

        async def film(client: DepthClient, count: int) -> None:
            for _ in range(count):
                async with client.open_session(RIG) as session:
                    session.submit(frame.left, frame.right)
                    session.submit(frame.left, frame.right)
                    session.end()
                    results = [result.frame_id async for result in session]
                    assert results == sorted(results)
                assert session.state is SessionState.ENDED
                with pytest.raises(StopAsyncIteration):
                    await anext(session)

        async with DepthClient(server.grpc_address) as client:
            await asyncio.gather(*(film(client, 5) for _ in range(25)))
        await eventually(lambda: len(server.engine.streams) == 0)


async def test_leaving_in_an_outage_neither_waits_nor_raises_into_the_reader() -> None:
    async with scene() as rough:
        async with rough.open_session() as session:
            reading = asyncio.create_task(_read(session))
            await step(session, 1)
            rough.proxy.fall_silent()
            submit(session, 2)
            await rough.until(EventKind.STALLED)
        assert await reading == []
        assert session.drops.lost == 1


async def _read(session: DepthSession) -> list[int]:
    return [result.frame_id async for result in session]


async def test_nothing_is_left_behind_by_sessions_whose_connection_was_lost() -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    async def disturbed(rough: Scene) -> None:
        for disturb in (rough.proxy.cut, rough.proxy.forget_connections):
            async with rough.open_session() as session:
                await step(session, 1)
                disturb()
                rough.proxy.mend()
                await step(session, 2)

    async with scene() as rough:
        await disturbed(rough)  # gRPC keeps threads and descriptors of its own from now on
        tasks, threads, files = len(asyncio.all_tasks()), threading.active_count(), descriptors()
        await disturbed(rough)
        await eventually(lambda: descriptors() <= files)
        await eventually(lambda: len(asyncio.all_tasks()) <= tasks)
        assert threading.active_count() <= threads
