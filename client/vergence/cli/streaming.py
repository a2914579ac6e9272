"""Streaming of a source from disk through a session: losslessly, or live at a rate."""

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterator, Collection
from dataclasses import dataclass

from vergence.results import DepthResult
from vergence.session import DepthSession
from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import SourceFrame
from vergence_proto.ordered import in_order


@dataclass(frozen=True, slots=True, eq=False)
class AnsweredFrame:
    """One frame of a source and its result."""

    index: int
    """The position of the frame in the source, from 0."""
    source: SourceFrame
    """The frame, with its ground truth if the source has any."""
    result: DepthResult
    """The result of the server."""
    latency_s: float
    """Seconds from handing the frame over to receiving its result."""

    def accuracy(self) -> Accuracy | None:
        """Compare with the ground truth; None if there is none."""
        if self.source.truth_px is None:
            return None
        return accuracy(self.result.offset_px, self.source.truth_px, self.source.truth_mask)


def every_frame(
    session: DepthSession,
    frames: AsyncIterator[tuple[int, SourceFrame]],
    *,
    in_flight: int,
    resets: Collection[int] = (),
) -> AsyncGenerator[AnsweredFrame, None]:
    """Step every frame, in order, with up to ``in_flight`` of them on the way.

    With 1 the latency is that of a frame alone; with the session's credit the server never waits.
    The stream's memory is discarded before the frames at the indices ``resets``.
    """

    async def step(indexed: tuple[int, SourceFrame]) -> AnsweredFrame:
        index, source = indexed
        frame = source.frame
        if index in resets:
            session.reset()
        started_s = time.monotonic()
        result = await session.step(
            frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns
        )
        return AnsweredFrame(index, source, result, time.monotonic() - started_s)

    # A reset applies to the next frame that is sent, which must be this one.
    return in_order(frames, step, limit=1 if resets else in_flight)


async def live_frames(
    session: DepthSession, frames: AsyncIterator[tuple[int, SourceFrame]], *, rate_hz: float | None
) -> AsyncGenerator[AnsweredFrame, None]:
    """Submit frames at a rate, as a camera would; the session counts those that are dropped.

    Without a rate, frames are submitted as they come.
    """
    sent: dict[int, tuple[int, SourceFrame]] = {}

    async def film() -> None:
        started_s = time.monotonic()
        try:
            async for index, source in frames:
                if rate_hz is not None:
                    await asyncio.sleep(started_s + index / rate_hz - time.monotonic())
                frame = source.frame
                at_ns = frame.capture_ns if rate_hz is None else None  # None: now
                frame_id = session.submit(frame.left, frame.right, frame.pose, capture_ns=at_ns)
                if frame_id:
                    sent[frame_id] = index, source
        finally:
            session.end()  # the reader below ends after the last answer

    camera = asyncio.create_task(film())
    try:
        async for result in session:
            index, source = sent[result.frame_id]
            for frame_id in [older for older in sent if older <= result.frame_id]:
                del sent[frame_id]  # answers come in order: the older ones were dropped
            yield AnsweredFrame(index, source, result, result.age_s)
        await camera
    finally:
        camera.cancel()
        await asyncio.gather(camera, return_exceptions=True)
