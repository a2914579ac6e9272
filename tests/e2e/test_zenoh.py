"""The SDK and the server over a real Zenoh router: the same answers, and what if it dies."""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Any

import numpy as np
import pytest

from tests.client.waiting import eventually
from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.server import running_server
from tests.support.zenoh_net import address_of, free_endpoint, router
from vergence import (
    ConnectionLost,
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    Draining,
    EventKind,
    FrameTooLarge,
    Origin,
    OutputFormat,
    PlaneEncoding,
    SessionEvent,
    StreamExists,
    StreamLimit,
    Superseded,
    UnknownStream,
    depth,
)
from vergence_service.app import Running, drain

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32, sigma=True, confidence=True)
LOSSLESS = Delivery.EVERY


async def step(session: DepthSession, frame_id: int) -> DepthResult:
    frame = make_frame(frame_id)
    return await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


def submit(session: DepthSession, frame_id: int) -> int | None:
    frame = make_frame(frame_id)
    return session.submit(frame.left, frame.right, frame.pose)


@asynccontextmanager
async def server_on(
    endpoint: str, model: RecallModel | None = None, **flags: Any
) -> AsyncIterator[Running]:
    """A server that joins the router at ``endpoint``."""
    async with running_server(
        model or RecallModel(),
        zenoh__enabled=True,
        zenoh__mode="client",
        zenoh__connect=[endpoint],
        **flags,
    ) as server:
        yield server


@asynccontextmanager
async def lone_server(
    model: RecallModel | None = None, **flags: Any
) -> AsyncIterator[tuple[Running, str]]:
    """A server that is its own router, and its address."""
    endpoint = free_endpoint()
    async with running_server(
        model or RecallModel(), zenoh__enabled=True, zenoh__listen=[endpoint], **flags
    ) as server:
        yield server, address_of(endpoint)


def held(server: Running) -> list[str]:
    """The streams of this server, of those called a and b."""
    found = []
    for stream_id in ("a", "b"):
        with suppress(UnknownStream):
            found.append(server.engine.streams.get(stream_id).stream_id)
    return found


def attached(server: Running, session: DepthSession) -> bool:
    return server.engine.streams.get(session.stream_id).attachment is not None


@pytest.mark.parametrize("delivery", Delivery, ids=lambda delivery: delivery.name)
async def test_a_sequence_is_answered_alike_over_grpc_and_zenoh(delivery: Delivery) -> None:
    async def walk(address: str) -> list[DepthResult]:
        async with (
            DepthClient(address) as client,
            client.open_session(RIG, delivery=delivery, output=EXACT) as session,
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


async def test_a_live_stream_outlives_its_router_and_says_what_it_lost() -> None:
    events: list[SessionEvent] = []
    model = RecallModel()
    async with (
        router() as between,
        server_on(between.endpoint, model) as server,
        DepthClient(between.address) as client,
        client.open_session(RIG, on_event=events.append) as session,
    ):
        before = await step(session, 1)
        with model.busy():
            submit(session, 2)
            await asyncio.to_thread(model.wait_until_entered)
            await asyncio.to_thread(model.wait_until_entered)
            await between.kill()
            await eventually(lambda: events and not attached(server, session))
            assert submit(session, 3) is None  # while it is away
        await between.start()
        await eventually(lambda: len(events) == 2)
        after = await step(session, 4)
    assert [event.kind for event in events] == [EventKind.DISCONNECTED, EventKind.RESUMED]
    assert (before.origin, after.origin) == (Origin.COLD_START, Origin.RESUMED)
    assert (before.step_count, after.step_count) == (1, 2)
    assert (session.drops.lost, session.drops.at_source) == (1, 1)


async def test_a_lossless_stream_outlives_its_router_and_loses_nothing() -> None:
    model = RecallModel()
    async with (
        router() as between,
        server_on(between.endpoint, model) as server,
        DepthClient(between.address) as client,
        client.open_session(RIG, delivery=LOSSLESS) as session,
    ):
        with model.busy():
            steps = [asyncio.create_task(step(session, frame_id)) for frame_id in range(1, 6)]
            await asyncio.to_thread(model.wait_until_entered)
            await between.kill()
            await eventually(lambda: not attached(server, session))
        await between.start()
        results = await asyncio.gather(*steps)
    assert [result.step_count for result in results] == [1, 2, 3, 4, 5]
    assert [result.frames_skipped for result in results] == [0] * 5
    assert session.drops.total == 0


async def test_every_live_frame_is_accounted_for() -> None:
    model = RecallModel()
    async with (
        lone_server(model, grpc__credit=5) as (_, address),
        DepthClient(address) as client,
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


def only(messages: str, key: str, size: int) -> dict[str, Any]:
    """What a router lets pass: of the messages on a key, those of at most ``size`` bytes."""
    return {
        "flows": ["egress"],
        "messages": [messages],
        "key_exprs": [key],
        "size_limit": size,
    }


@pytest.mark.parametrize("way", ["frames", "disparity"])
async def test_what_the_network_loses_is_found_out_and_gives_its_credit_back(way: str) -> None:
    # A router that lets no image pass, but everything small.
    lossy = router(low_pass_filter=[only("put", f"vergence/v1/*/{way}", 2000)])
    async with (
        lossy as between,
        server_on(between.endpoint) as server,
        DepthClient(between.address) as client,
        client.open_session(RIG) as session,
    ):
        stream = server.engine.streams.get(session.stream_id)
        for frame_id in range(1, 1 + session.credit):
            assert submit(session, frame_id) == frame_id
            if way == "disparity":
                await eventually(lambda: stream.frames_stepped == frame_id)  # noqa: B023 -- awaited here
        await eventually(lambda: session.drops.displaced == session.credit)
        assert submit(session, 9) is not None
        assert stream.frames_stepped == (0 if way == "frames" else session.credit)


async def test_a_dead_headset_is_noticed_and_its_stream_waits_for_the_next() -> None:
    async with lone_server() as (server, address):
        script = f"""
import asyncio, sys
from tests.support.frames import RIG, make_frame
from vergence import DepthClient

async def main():
    async with DepthClient({address!r}) as client, client.open_session(RIG, stream_id="head") as it:
        frame = make_frame(1)
        await it.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
        print(it.resume_token.hex(), flush=True)
        await asyncio.sleep(60)

asyncio.run(main())
"""
        headset = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", script),
            stdout=asyncio.subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert headset.stdout is not None
        token = bytes.fromhex((await headset.stdout.readline()).decode())
        headset.send_signal(signal.SIGKILL)
        await headset.wait()
        await eventually(lambda: server.engine.streams.get("head").attachment is None)
        async with (
            DepthClient(address) as client,
            client.open_session(RIG, stream_id="head", resume_token=token) as session,
        ):
            result = await step(session, 2)
    assert (result.frame_id, result.origin, result.step_count) == (2, Origin.RESUMED, 2)


async def test_a_server_that_never_comes_back_is_given_up_after_the_grace() -> None:
    events: list[SessionEvent] = []
    async with router() as between, AsyncExitStack() as dies, AsyncExitStack() as stays:
        await dies.enter_async_context(server_on(between.endpoint, streams__detach_grace_s=0.3))
        client = await stays.enter_async_context(DepthClient(between.address))
        session = await stays.enter_async_context(client.open_session(RIG, on_event=events.append))
        await step(session, 1)
        await dies.aclose()
        with pytest.raises(ConnectionLost, match=r"in 0\.3 s"):
            await anext(session)
    assert [event.kind for event in events] == [EventKind.DISCONNECTED]


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
            await client.open_session(RIG, stream_id="c").__aenter__()
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
        lone_server(grpc__max_frame_mib=1) as (_, address),
        DepthClient(address) as client,
        client.open_session(RIG) as session,
    ):
        with pytest.raises(FrameTooLarge, match="1048576"):
            await session.step(big, big)
        assert (await step(session, 2)).step_count == 1


async def test_a_server_that_shuts_down_says_so() -> None:
    events: list[SessionEvent] = []
    async with (
        lone_server() as (server, address),
        DepthClient(address) as client,
        client.open_session(RIG, on_event=events.append) as session,
    ):
        await step(session, 1)
        draining = asyncio.create_task(drain(server, within_s=0.2))
        with pytest.raises(Draining):
            await anext(session)
        await draining
    assert [event.kind for event in events] == [EventKind.DRAINING]


async def test_a_server_that_falls_silent_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vergence.transports.zenoh_call._PONG_PATIENCE_S", 0.5)
    events: list[SessionEvent] = []
    # Tokens and queries pass the router, and nothing else.
    async with (
        router(low_pass_filter=[only("put", "vergence/v1/*/status", 0)]) as between,
        server_on(between.endpoint),
        DepthClient(between.address) as client,
        client.open_session(RIG, on_event=events.append),
    ):
        await eventually(lambda: len(events) == 2)
        assert [event.kind for event in events] == [EventKind.DISCONNECTED, EventKind.RESUMED]
    assert "has not answered" in events[0].message


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
