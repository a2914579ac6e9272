"""Losing the connection is not losing the stream: the wire is cut by a proxy of our own."""

import asyncio

import numpy as np
import pytest

from tests.support.frames import make_frame
from tests.support.scene import scene
from tests.support.session_frames import step
from vergence import Delivery, DepthResult, EventKind, NotSent, Origin, Pose


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
        assert rough.proxy.accepted >= 2
    for result, same in zip(results, expected, strict=True):
        np.testing.assert_array_equal(result.disparity_px, same.disparity_px)
        assert result.step_count == same.step_count
    assert [result.origin for result in results[2:5]] == [Origin.WARM, Origin.RESUMED, Origin.WARM]
    assert rough.kinds == [EventKind.DISCONNECTED, EventKind.RESUMED]


@pytest.mark.parametrize(
    ("later_s", "metres", "origin", "words"),
    [
        (60.0, 0.0, Origin.RESET_GAP, "too much time has passed"),
        (0.1, 50.0, Origin.RESET_POSE_JUMP, "moved too far"),
    ],
)
async def test_a_resumed_stream_that_starts_cold_says_so(
    later_s: float, metres: float, origin: Origin, words: str
) -> None:
    async with scene() as rough, rough.open_session(Delivery.EVERY) as session:
        await step(session, 1)
        rough.proxy.cut()
        await rough.until(EventKind.DISCONNECTED)
        rough.proxy.mend()
        await rough.until(EventKind.RESUMED)
        frame = make_frame(2)
        pose = Pose(np.eye(3), np.array([metres, 0.0, 0.0]))
        result = await session.step(
            frame.left, frame.right, pose, capture_ns=frame.capture_ns + int(later_s * 1e9)
        )
        assert result.origin is origin
        assert rough.kinds == [EventKind.DISCONNECTED, EventKind.RESUMED, EventKind.RESTARTED]
        assert words in rough.events[-1].message


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
        assert session.submit(frame.left, frame.right) is NotSent.OFFLINE
        rough.proxy.mend()
        await rough.until(EventKind.RESUMED)
        frame = make_frame(3)
        session.submit(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
        result = await anext(session)
        assert (result.origin, result.step_count) == (Origin.RESUMED, 2)
        assert (result.drops.lost, result.drops.offline, result.drops.total) == (1, 1, 2)
