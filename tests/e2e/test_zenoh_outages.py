"""Over a real Zenoh router, processes die, fall silent and lose messages; sessions recover."""

import asyncio
import itertools
import os
import signal
import sys
from contextlib import AsyncExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.session_frames import EXACT
from tests.support.zenoh_net import router
from tests.support.zenoh_sessions import LOSSLESS, attached, lone_server, server_on, step, submit
from vergence import (
    ConnectionLost,
    DepthClient,
    Draining,
    EventKind,
    ImageEncoding,
    NotSent,
    Origin,
    SessionEvent,
)
from vergence_service.app.server import drain


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
            assert submit(session, 3) is NotSent.OFFLINE
        await between.start()
        await eventually(lambda: len(events) == 2)
        after = await step(session, 4)
    assert [event.kind for event in events] == [EventKind.DISCONNECTED, EventKind.RESUMED]
    assert (before.origin, after.origin) == (Origin.COLD_START, Origin.RESUMED)
    assert (before.step_count, after.step_count) == (1, 2)
    assert (session.drops.lost, session.drops.offline) == (1, 1)


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


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the secret chunk in the keys of the first attachment; no wildcard matches it."""
    ids = (f"{number:032x}" for number in itertools.count(1))
    choice = SimpleNamespace(token_hex=lambda _: next(ids))
    monkeypatch.setattr("vergence.transports.zenoh_call.secrets", choice)
    return f"@{1:032x}"


def only(messages: str, key: str, size: int) -> dict[str, Any]:
    """A router that lets only messages of at most ``size`` bytes pass on a key."""
    return {
        "flows": ["egress"],
        "messages": [messages],
        "key_exprs": [key],
        "size_limit": size,
    }


@pytest.mark.parametrize("way", ["frames", "disparity"])
async def test_what_the_network_loses_is_found_out_and_gives_its_credit_back(
    way: str, place: str
) -> None:
    # A router that lets no image pass, but everything small.
    lossy = router(low_pass_filter=[only("put", f"vergence/v1/{place}/*/{way}", 2000)])
    async with (
        lossy as between,
        server_on(between.endpoint) as server,
        DepthClient(between.address) as client,
        client.open_session(RIG, encoding=ImageEncoding.RAW, output=EXACT, link="fixed") as session,
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


async def test_another_server_takes_a_stream_over_whose_own_never_comes_back() -> None:
    events: list[SessionEvent] = []
    async with router() as between, AsyncExitStack() as dies, AsyncExitStack() as stays:
        await dies.enter_async_context(server_on(between.endpoint))
        client = await stays.enter_async_context(DepthClient(between.address))
        session = await stays.enter_async_context(client.open_session(RIG, on_event=events.append))
        await step(session, 1)
        await stays.enter_async_context(server_on(between.endpoint))
        await dies.aclose()
        result = await step(session, 2)
        assert (result.frame_id, result.origin) == (2, Origin.COLD_START)
        assert [event.kind for event in events] == [EventKind.DISCONNECTED, EventKind.RESTARTED]


async def test_a_server_that_never_comes_back_is_given_up_when_it_cannot_have_the_stream() -> None:
    events: list[SessionEvent] = []
    async with router() as between, AsyncExitStack() as dies, AsyncExitStack() as stays:
        await dies.enter_async_context(
            server_on(between.endpoint, streams__detach_grace_s=0.3, streams__idle_timeout_s=0.2)
        )
        client = await stays.enter_async_context(DepthClient(between.address))
        session = await stays.enter_async_context(
            client.open_session(RIG, on_event=events.append, on_lost="raise")
        )
        await dies.aclose()
        with pytest.raises(ConnectionLost, match=r"in 0\.5 s"):
            await anext(session)
    assert [event.kind for event in events] == [EventKind.DISCONNECTED]


async def test_a_server_that_shuts_down_says_so() -> None:
    events: list[SessionEvent] = []
    async with (
        lone_server() as (server, address),
        DepthClient(address) as client,
        client.open_session(RIG, on_event=events.append, on_lost="raise") as session,
    ):
        await step(session, 1)
        draining = asyncio.create_task(drain(server, within_s=0.2))
        with pytest.raises(Draining):
            await anext(session)
        await draining
    assert [event.kind for event in events] == [EventKind.DRAINING]


async def test_a_server_that_falls_silent_is_left(place: str) -> None:
    events: list[SessionEvent] = []
    # Tokens and queries pass the router, and nothing else.
    async with (
        router(low_pass_filter=[only("put", f"vergence/v1/{place}/*/status", 0)]) as between,
        server_on(between.endpoint),
        DepthClient(between.address) as client,
        client.open_session(RIG, on_event=events.append),
    ):
        await eventually(lambda: len(events) == 2)
        assert [event.kind for event in events] == [EventKind.STALLED, EventKind.RESUMED]
