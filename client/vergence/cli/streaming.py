"""A source from disk through a session, frame by frame: losslessly, or live at a rate."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import dataclass

from vergence.results import DepthResult
from vergence.session import DepthSession
from vergence_proto.datasets import SourceFrame


@dataclass(frozen=True, slots=True, eq=False)
class Answered:
    """One frame of a source and what came of it."""

    index: int  # in the source, from 0
    source: SourceFrame
    result: DepthResult
    latency_s: float  # from handing the frame over to having its result


async def every_frame(
    session: DepthSession, frames: AsyncIterator[tuple[int, SourceFrame]], *, in_flight: int
) -> AsyncGenerator[Answered, None]:
    """Step every frame, in order, with up to ``in_flight`` of them on the way.

    With 1 a latency is that of a frame alone; with the session's credit the server never waits.
    """
    waiting: deque[asyncio.Task[Answered]] = deque()
    try:
        async for index, frame in frames:
            if len(waiting) == in_flight:
                yield await waiting.popleft()
            waiting.append(asyncio.create_task(_step(session, index, frame)))
        while waiting:
            yield await waiting.popleft()
    finally:
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)


async def _step(session: DepthSession, index: int, source: SourceFrame) -> Answered:
    frame = source.frame
    started_s = time.monotonic()
    result = await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
    return Answered(index, source, result, time.monotonic() - started_s)


async def live_frames(
    session: DepthSession, frames: AsyncIterator[tuple[int, SourceFrame]], *, rate_hz: float
) -> AsyncGenerator[Answered, None]:
    """Submit frames at a rate, as a camera would; the session counts those that are dropped."""
    sent: dict[int, tuple[int, SourceFrame]] = {}

    async def film() -> None:
        started_s = time.monotonic()
        try:
            async for index, source in frames:
                await asyncio.sleep(started_s + index / rate_hz - time.monotonic())
                frame = source.frame
                if frame_id := session.submit(frame.left, frame.right, frame.pose):
                    sent[frame_id] = index, source
        finally:
            session.end()  # the reader below ends after the last answer

    camera = asyncio.create_task(film())
    try:
        async for result in session:
            index, source = sent[result.frame_id]
            for frame_id in [older for older in sent if older <= result.frame_id]:
                del sent[frame_id]  # answers come in order: these were dropped on the way
            yield Answered(index, source, result, result.age_s)
        await camera
    finally:
        camera.cancel()
        await asyncio.gather(camera, return_exceptions=True)
