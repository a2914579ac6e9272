"""Live and lossless frames: the order, displacement and drops, with every frame counted."""

import asyncio

import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RAISES, RecallModel
from tests.support.polling import eventually
from tests.support.server import running_server
from tests.support.session_frames import step, submit
from vergence import (
    Delivery,
    DepthClient,
    DepthSession,
    FrameStale,
    ModelFailed,
    NotSent,
    WrongDelivery,
)


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
            assert taken == [1, 2] + [NotSent.CREDIT] * 8
            assert not any(taken[2:])
            assert session.drops.at_source == 8
        first, second = [await anext(session) for _ in range(2)]
        assert (first.frame_id, second.frame_id) == (1, 2)
        assert submit(session, 11) == 3  # ids have no gap: what is not sent has none
        assert (await anext(session)).drops.total == 8


async def test_a_newer_frame_displaces_one_that_waits_and_every_frame_is_accounted_for(
    model: RecallModel,
) -> None:
    async with (
        running_server(model, streams__credit=5) as server,
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
        with pytest.raises(WrongDelivery, match=r"use step\(\)"):
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
        running_server(model, streams__credit=3) as server,
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
