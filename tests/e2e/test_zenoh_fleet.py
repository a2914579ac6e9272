"""Three servers, two routers and one Redis: streams are spread, and outlive their server."""

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager

import numpy as np
import pytest

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.redis_server import RedisServer, redis_server
from tests.support.server import running_server
from tests.support.server_process import recall_server_process
from tests.support.session_frames import EXACT, step
from tests.support.zenoh_net import Router, router
from vergence import Delivery, DepthClient, DepthResult, EventKind, SessionEvent
from vergence_service.snapshots.snapshot import StreamSnapshot

pytestmark = pytest.mark.slow  # it needs redis-server, and starts five processes

STREAMS = ("a", "b", "c")


class Servers:
    """A process each. The first has joined the first router, the others the second one."""

    def __init__(
        self, stack: AsyncExitStack, routers: Sequence[Router], store: RedisServer
    ) -> None:
        self._processes = {}
        for endpoint in (routers[0].endpoint, routers[1].endpoint, routers[1].endpoint):
            address, process = stack.enter_context(
                recall_server_process(
                    zenoh__enabled=True,
                    zenoh__mode="client",
                    zenoh__connect=[endpoint],
                    snapshots__store=store.url,
                )
            )
            self._processes[address] = process

    async def streams_open(self) -> dict[str, int]:
        """By the address of those that live."""
        counts = {}
        for address, process in self._processes.items():
            if process.poll() is None:
                async with DepthClient(address) as client:
                    counts[address] = (await client.server_info()).streams_open
        return counts

    def kill(self, address: str) -> None:
        self._processes[address].kill()
        self._processes[address].wait()


@asynccontextmanager
async def network() -> AsyncIterator[tuple[Servers, tuple[Router, Router], RedisServer]]:
    async with (
        router() as first,
        router(connect__endpoints=[first.endpoint]) as second,
        AsyncExitStack() as stack,
    ):
        store = stack.enter_context(redis_server())
        yield Servers(stack, (first, second), store), (first, second), store


async def undisturbed(frame_ids: Sequence[int]) -> list[DepthResult]:
    async with (
        running_server(RecallModel()) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        return [await step(session, frame_id) for frame_id in frame_ids]


def stored_frames(store: RedisServer) -> list[int]:
    values = [store.admin.hget(key, "value") for key in store.names()]
    return [StreamSnapshot.from_bytes(value).last_frame_id for value in values if value]


@pytest.mark.timeout(120)
async def test_a_stream_of_a_killed_server_goes_on_at_another_router_to_the_bit() -> None:
    events: list[SessionEvent] = []
    results: dict[str, list[DepthResult]] = {stream_id: [] for stream_id in STREAMS}
    async with (
        network() as (servers, routers, store),
        DepthClient(routers[0].address) as near,
        DepthClient(routers[1].address) as far,
        AsyncExitStack() as open_sessions,
    ):
        sessions = {}
        for stream_id, client in zip(STREAMS, (near, far, near), strict=True):
            before = await servers.streams_open()
            sessions[stream_id] = await open_sessions.enter_async_context(
                client.open_session(
                    RIG,
                    delivery=Delivery.EVERY,
                    output=EXACT,
                    stream_id=stream_id,
                    on_event=events.append,
                )
            )
            after = await servers.streams_open()
            [chosen] = [address for address in after if after[address] > before[address]]
            assert before[chosen] == 0  # the server with the most room, behind either router
            for frame_id in (1, 2, 3):
                results[stream_id].append(await step(sessions[stream_id], frame_id))
        await eventually(lambda: stored_frames(store) == [3, 3, 3])

        killed, *others = after
        servers.kill(killed)  # it was alone behind the first router
        for stream_id in STREAMS:
            for frame_id in (4, 5, 6):
                results[stream_id].append(await step(sessions[stream_id], frame_id))
        left = await servers.streams_open()
        assert list(left) == others
        assert sorted(left.values()) == [1, 2]
    kinds = [event.kind for event in events]
    assert kinds.count(EventKind.RESUMED) == 1
    assert EventKind.RESTARTED not in kinds
    expected = await undisturbed(range(1, 7))
    for stream_id in STREAMS:
        for result, same in zip(results[stream_id], expected, strict=True):
            np.testing.assert_array_equal(result.disparity_px, same.disparity_px)
            assert result.step_count == same.step_count
