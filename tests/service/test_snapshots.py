"""A stream outlives its server: another one resumes it from the snapshot in a real Redis."""

import asyncio
import logging
import os
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.proxy import Proxy, proxy_to
from tests.support.redis_server import RedisServer, redis_server
from tests.support.server import running_server
from tests.support.server_process import recall_server_process
from tests.support.session_frames import EXACT, step, submit
from vergence import Delivery, DepthClient, DepthResult, EventKind, Origin, SessionEvent
from vergence_proto.errors import BadCalibration, StreamExists
from vergence_service.app.server import Running, drain
from vergence_service.snapshots.snapshot import StreamSnapshot

pytestmark = pytest.mark.slow  # it needs redis-server


@pytest.fixture(scope="module")
def started() -> Iterator[RedisServer]:
    with redis_server() as server:
        yield server


@pytest.fixture
def store(started: RedisServer) -> RedisServer:
    started.admin.flushall()
    return started


class Fleet:
    """Two servers, each with a wire of its own to Redis, and a front that leads to one of them."""

    def __init__(
        self, a: Running, b: Running, wires: tuple[Proxy, Proxy], front: Proxy, client: DepthClient
    ) -> None:
        self.a, self.b, self.front, self.client = a, b, front, client
        self.wire_a, self.wire_b = wires
        self.events: list[SessionEvent] = []

    def session(self, delivery: Delivery = Delivery.EVERY, **choices: Any) -> Any:
        return self.client.open_session(
            RIG, delivery=delivery, output=EXACT, on_event=self.events.append, **choices
        )

    async def move_to(self, server: Running) -> None:
        before = len(self.resumed)
        self.front.lead_to(server.grpc_address)
        await eventually(lambda: len(self.resumed) > before)

    @property
    def resumed(self) -> list[SessionEvent]:
        return [event for event in self.events if event.kind is EventKind.RESUMED]

    @property
    def restarted(self) -> list[SessionEvent]:
        return [event for event in self.events if event.kind is EventKind.RESTARTED]


def count(server: Running, outcome: str) -> float:
    value: float = server.engine.metrics.snapshots.labels(outcome)._value.get()  # noqa: SLF001
    return value


@asynccontextmanager
async def fleet(store: RedisServer, **flags: Any) -> AsyncIterator[Fleet]:
    async with (
        proxy_to(store.address) as wire_a,
        proxy_to(store.address) as wire_b,
        running_server(RecallModel(), snapshots__store=f"redis://{wire_a.address}/0", **flags) as a,
        running_server(RecallModel(), snapshots__store=f"redis://{wire_b.address}/0", **flags) as b,
        proxy_to(a.grpc_address) as front,
        DepthClient(front.address) as client,
    ):
        yield Fleet(a, b, (wire_a, wire_b), front, client)


async def undisturbed(frame_ids: list[int]) -> list[DepthResult]:
    async with (
        running_server(RecallModel()) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        return [await step(session, frame_id) for frame_id in frame_ids]


def assert_same(results: list[DepthResult], expected: list[DepthResult]) -> None:
    for result, same in zip(results, expected, strict=True):
        np.testing.assert_array_equal(result.disparity_px, same.disparity_px)
        assert result.step_count == same.step_count


async def test_another_server_continues_a_lossless_session_to_the_bit(store: RedisServer) -> None:
    async with fleet(store) as two, two.session() as session:
        results = [await step(session, frame_id) for frame_id in (1, 2, 3)]
        await eventually(lambda: count(two.a, "saved") >= 2)
        await two.move_to(two.b)
        results += [await step(session, frame_id) for frame_id in (4, 5, 6)]
        assert not two.restarted
    assert_same(results, await undisturbed([1, 2, 3, 4, 5, 6]))
    await eventually(lambda: not store.names())  # the end of a session removes its snapshot


async def test_answered_frames_that_no_snapshot_has_are_sent_again(store: RedisServer) -> None:
    async with fleet(store) as two, two.session() as session:
        results = [await step(session, frame_id) for frame_id in (1, 2)]
        await eventually(lambda: stored_frame(store) == 2)
        two.wire_a.cut()
        results += [await step(session, 3)]
        session.reset()
        results += [await step(session, frame_id) for frame_id in (4, 5)]
        await two.move_to(two.b)
        results += [await step(session, frame_id) for frame_id in (6, 7)]
        stepped = two.b.engine.metrics.frames_stepped.labels("reset_requested")
        assert stepped._value.get() == 1  # noqa: SLF001  the reset, again, before frame 4
    async with (
        running_server(RecallModel()) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        expected = [await step(session, frame_id) for frame_id in (1, 2, 3)]
        session.reset()
        expected += [await step(session, frame_id) for frame_id in (4, 5, 6, 7)]
    assert_same(results, expected)


async def test_a_live_session_goes_on_from_the_snapshot(store: RedisServer) -> None:
    async with fleet(store) as two, two.session(Delivery.NEWEST) as session:
        results = []
        for frame_id in (1, 2, 3, 4):
            if frame_id == 3:
                await eventually(lambda: stored_frame(store) == 2)
                two.wire_a.cut()
            assert submit(session, frame_id) == frame_id
            results.append(await anext(session))
        await two.move_to(two.b)
        for frame_id in (5, 6):
            assert submit(session, frame_id) == frame_id
            results.append(await anext(session))
        assert results[4].origin is Origin.RESUMED
    assert_same(results[:2] + results[4:], await undisturbed([1, 2, 5, 6]))


async def test_a_server_that_was_cut_off_cannot_overwrite_its_successor(
    store: RedisServer,
) -> None:
    async with fleet(store) as two, two.session() as session:
        results = [await step(session, 1)]
        await eventually(lambda: stored_frame(store) == 1)
        two.wire_a.fall_silent()
        results += [await step(session, frame_id) for frame_id in (2, 3)]
        await two.move_to(two.b)
        results += [await step(session, frame_id) for frame_id in (4, 5)]
        await eventually(lambda: stored_frame(store) == 5)
        two.wire_a.mend()  # what A has tried to write since arrives now
        await eventually(lambda: count(two.a, "superseded"))
        assert stored_frame(store) == 5
        await eventually(lambda: not len(two.a.engine.streams))
        await two.move_to(two.a)
        results += [await step(session, 6)]
    assert_same(results, await undisturbed([1, 2, 3, 4, 5, 6]))


async def test_a_server_that_still_has_an_older_state_takes_the_newer_snapshot(
    store: RedisServer,
) -> None:
    async with fleet(store) as two, two.session() as session:
        results = [await step(session, frame_id) for frame_id in (1, 2)]
        await two.move_to(two.b)
        results += [await step(session, frame_id) for frame_id in (3, 4)]
        assert len(two.a.engine.streams) == 1  # it waits for its client
        await two.move_to(two.a)
        results += [await step(session, frame_id) for frame_id in (5, 6)]
    assert_same(results, await undisturbed([1, 2, 3, 4, 5, 6]))


async def test_a_suspended_process_wakes_up_and_changes_nothing(store: RedisServer) -> None:
    with recall_server_process(snapshots__store=store.url) as (address, process):
        async with fleet(store) as two:
            two.front.lead_to(address)
            async with two.session() as session:
                results = [await step(session, frame_id) for frame_id in (1, 2)]
                late = asyncio.create_task(step(session, 3))
                await asyncio.sleep(0)
                os.kill(process.pid, signal.SIGSTOP)
                try:
                    await two.move_to(two.b)
                    results += [await late, await step(session, 4)]
                    await eventually(lambda: stored_frame(store) == 4)
                finally:
                    os.kill(process.pid, signal.SIGCONT)
                two.front.lead_to(address)
                await eventually(lambda: len(two.resumed) == 2)
                results += [await step(session, frame_id) for frame_id in (5, 6)]
                assert not two.restarted
    assert_same(results, await undisturbed([1, 2, 3, 4, 5, 6]))


async def test_a_drain_hands_the_newest_state_over(store: RedisServer) -> None:
    async with fleet(store) as two, two.session(Delivery.NEWEST) as session:
        results = []
        for frame_id in (1, 2, 3):
            assert submit(session, frame_id) == frame_id
            results.append(await anext(session))
        draining = asyncio.create_task(drain(two.a, within_s=0.1))
        await eventually(lambda: EventKind.DRAINING in [event.kind for event in two.events])
        await two.move_to(two.b)
        await draining
        assert submit(session, 4) == 4
        results.append(await anext(session))
    assert_same(results, await undisturbed([1, 2, 3, 4]))


async def test_only_the_token_and_the_rig_of_the_stream_resume_it(store: RedisServer) -> None:
    async with fleet(store) as two, two.session(stream_id="mine") as session:
        await step(session, 1)
        await eventually(lambda: stored_frame(store) == 1)
        async with DepthClient(two.b.grpc_address) as stranger:
            with pytest.raises(StreamExists):
                async with stranger.open_session(RIG, stream_id="mine", resume_token=b"guess"):
                    pass
            with pytest.raises(BadCalibration):
                async with stranger.open_session(
                    replace(RIG, baseline_m=0.2),
                    stream_id="mine",
                    resume_token=session.resume_token,
                ):
                    pass
        await step(session, 2)
        await eventually(lambda: stored_frame(store) == 2)  # neither has fenced its owner


@pytest.mark.parametrize("trouble", ["down", "full", "slow", "wiped"])
async def test_whatever_happens_to_redis_streams_go_on(
    store: RedisServer, trouble: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    async with fleet(store, snapshots__timeout_s=0.2) as two, two.session() as session:
        results = [await step(session, 1)]
        await eventually(lambda: stored_frame(store) == 1)
        match trouble:
            case "down":
                two.wire_a.cut()
            case "full":
                store.admin.config_set("maxmemory", 1)
            case "slow":
                two.wire_a.fall_silent()
            case "wiped":
                store.admin.flushall()
        results += [await step(session, frame_id) for frame_id in range(2, 20)]
        if trouble != "wiped":
            await eventually(lambda: count(two.a, "failed") >= 2)
            assert [record.getMessage() for record in caplog.records if "stored:" in record.msg]
        two.wire_a.mend()
        store.admin.config_set("maxmemory", 0)
        await eventually(lambda: stored_frame(store) == 19)
    lines = [record for record in caplog.records if "cannot be stored" in record.getMessage()]
    assert len(lines) == (trouble != "wiped")
    assert_same(results, await undisturbed(list(range(1, 20))))


async def test_without_redis_a_new_server_starts_the_stream_again(store: RedisServer) -> None:
    async with fleet(store) as two, two.session() as session:
        await step(session, 1)
        two.wire_b.cut()
        two.front.lead_to(two.b.grpc_address)
        await eventually(lambda: two.restarted)
        assert (await step(session, 2)).origin is Origin.COLD_START


def stored_frame(store: RedisServer) -> int | None:
    """The frame of the only snapshot."""
    value = [store.admin.hget(key, "value") for key in store.names()]
    return StreamSnapshot.from_bytes(value[0]).last_frame_id if value and value[0] else None
