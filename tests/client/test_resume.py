"""Losing the connection is not losing the stream: the wire is cut by a proxy of our own."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.proxy import Proxy, proxy_to
from tests.support.server import ManualClock, running_server
from tests.support.session_frames import EXACT, step
from vergence import (
    ConnectionLost,
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    EventKind,
    ModelChanged,
    Origin,
    SessionEvent,
    StreamExpired,
    UnknownStream,
)


class Scene:
    """A session whose connection runs through a proxy, and the events that it reported."""

    def __init__(self, model: RecallModel, proxy: Proxy, client: DepthClient) -> None:
        self.model = model
        self.proxy = proxy
        self.client = client
        self.events: list[SessionEvent] = []

    def open_session(self, delivery: Delivery) -> DepthSession:
        return self.client.open_session(
            RIG, delivery=delivery, output=EXACT, on_event=self.events.append
        )

    async def until(self, kind: EventKind) -> None:
        await eventually(lambda: kind in [event.kind for event in self.events])


@asynccontextmanager
async def scene(*, clock: ManualClock | None = None, **flags: Any) -> AsyncIterator[Scene]:
    model = RecallModel()
    async with (
        running_server(model, clock=clock, **flags) as server,
        proxy_to(server.grpc_address) as proxy,
        DepthClient(proxy.address) as client,
    ):
        yield Scene(model, proxy, client)


async def undisturbed(count: int) -> list[DepthResult]:
    async with scene() as quiet, quiet.open_session(Delivery.EVERY) as session:
        return [await step(session, frame_id) for frame_id in range(1, count + 1)]


async def test_a_cut_connection_resumes_with_the_state_as_it_was() -> None:
    expected = await undisturbed(6)
    async with scene() as rough, rough.open_session(Delivery.EVERY) as session:
        results = [await step(session, frame_id) for frame_id in (1, 2, 3)]
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        rough.proxy.mend()
        results += [await step(session, frame_id) for frame_id in (4, 5, 6)]
        assert rough.proxy.accepted == 2
    for result, same in zip(results, expected, strict=True):
        np.testing.assert_array_equal(result.disparity_px, same.disparity_px)
        assert result.step_count == same.step_count
    assert [result.origin for result in results[2:5]] == [Origin.WARM, Origin.RESUMED, Origin.WARM]
    assert [event.kind for event in rough.events] == [EventKind.DISCONNECTED, EventKind.RESUMED]


async def test_a_step_that_never_arrived_is_sent_again() -> None:
    expected = await undisturbed(3)
    async with scene() as rough, rough.open_session(Delivery.EVERY) as session:
        await step(session, 1)
        rough.proxy.hold_upward()
        steps = [asyncio.create_task(step(session, frame_id)) for frame_id in (2, 3)]
        await asyncio.sleep(0.05)
        assert len(rough.model.batches) == 1
        rough.proxy.cut()
        rough.proxy.mend()
        results = await asyncio.gather(*steps)
    for result, same in zip(results, expected[1:], strict=True):
        np.testing.assert_array_equal(result.disparity_px, same.disparity_px)


async def test_a_step_that_was_under_way_is_taken_once_more_on_the_same_state() -> None:
    expected = await undisturbed(3)
    async with scene() as rough, rough.open_session(Delivery.EVERY) as session:
        await step(session, 1)
        with rough.model.busy():
            under_way = asyncio.create_task(step(session, 2))
            for _ in range(2):  # the first step, and this one
                await asyncio.to_thread(rough.model.wait_until_entered)
            rough.proxy.cut()
            await rough.until(EventKind.DISCONNECTED)
            rough.proxy.mend()
            await rough.until(EventKind.RESUMED)
        results = [await under_way, await step(session, 3)]
    for result, same in zip(results, expected[1:], strict=True):
        np.testing.assert_array_equal(result.disparity_px, same.disparity_px)


async def test_a_reset_asked_for_while_the_connection_is_down_is_not_forgotten() -> None:
    async with scene() as rough, rough.open_session(Delivery.EVERY) as session:
        await step(session, 1)
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        session.reset()
        rough.proxy.mend()
        result = await step(session, 2)
    assert result.origin is Origin.RESET_REQUESTED


async def test_live_frames_in_flight_are_counted_lost_and_the_next_ones_go_through() -> None:
    async with scene() as rough, rough.open_session(Delivery.NEWEST) as session:
        await step(session, 1)
        frame = make_frame(2)
        rough.proxy.hold_upward()
        assert session.submit(frame.left, frame.right) == 2
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        assert session.submit(frame.left, frame.right) is None
        rough.proxy.mend()
        await rough.until(EventKind.RESUMED)
        frame = make_frame(3)
        session.submit(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
        result = await anext(session)
        assert (result.origin, result.step_count) == (Origin.RESUMED, 2)
        assert (result.drops.lost, result.drops.at_source, result.drops.total) == (1, 1, 2)


async def test_beyond_the_grace_it_gives_up_and_says_so() -> None:
    async with (
        scene(streams__detach_grace_s=0.3) as rough,
        rough.open_session(Delivery.EVERY) as session,
    ):
        await step(session, 1)
        rough.proxy.cut()
        with pytest.raises(ConnectionLost, match=r"again in 0\.3 s"):
            await step(session, 2)
        with pytest.raises(ConnectionLost):
            await anext(session)


async def test_a_stream_that_expired_meanwhile_is_told_as_that() -> None:
    clock = ManualClock()
    async with scene(clock=clock) as rough, rough.open_session(Delivery.EVERY) as session:
        await step(session, 1)
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        clock.advance(100)
        rough.proxy.mend()
        with pytest.raises(StreamExpired):
            await step(session, 2)


async def test_a_server_that_restarted_has_forgotten_the_stream() -> None:
    async with (
        running_server(RecallModel()) as first,
        running_server(RecallModel()) as second,
        proxy_to(first.grpc_address) as proxy,
        DepthClient(proxy.address) as client,
        client.open_session(RIG) as session,
    ):
        await step(session, 1)
        proxy.lead_to(second.grpc_address)
        with pytest.raises(UnknownStream):
            await step(session, 2)


class OtherWeights(RecallModel):
    card = replace(RecallModel.card, weights_sha256="1" * 64)


async def test_a_stream_does_not_go_on_with_other_weights() -> None:
    async with (
        running_server(RecallModel()) as first,
        running_server(OtherWeights()) as second,
        proxy_to(first.grpc_address) as proxy,
        DepthClient(proxy.address) as client,
        client.open_session(RIG) as session,
    ):
        await step(session, 1)
        proxy.lead_to(second.grpc_address)
        with pytest.raises(ModelChanged, match="expected a server with weights 0000"):
            await step(session, 2)
        async with client.open_session(RIG) as fresh:
            assert (await step(fresh, 1)).step_count == 1


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


async def test_no_server_is_told_at_once_and_by_its_address() -> None:
    async with proxy_to("127.0.0.1:1") as proxy, DepthClient(proxy.address) as client:
        proxy.cut()
        with pytest.raises(ConnectionLost, match=proxy.address):
            await client.server_info()
        with pytest.raises(ConnectionLost, match=proxy.address):
            async with client.open_session(RIG):
                pass
