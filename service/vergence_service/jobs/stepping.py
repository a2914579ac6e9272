"""A whole sequence as one pure function of its frames and the model, and where to find one."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator
from dataclasses import dataclass

from vergence_proto.datasets import (
    SourceFrame,
    StereoSource,
    read_ahead,
)
from vergence_proto.types import DisparityMap
from vergence_service.inference.model import RecurrentState
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import Stream, StreamConfig

# One step is in the model while the answer of the one before is made ready.
_IN_FLIGHT = 2


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """One frame of a sequence and what came of it."""

    index: int  # from 0
    source: SourceFrame
    disparity: DisparityMap
    state: RecurrentState  # that it left


async def step_all(
    engine: DepthEngine,
    source: StereoSource,
    config: StreamConfig,
    *,
    start: int = 0,
    state: RecurrentState | None = None,
) -> AsyncGenerator[Stepped, None]:
    """Every frame of ``source`` in order, each on the state that its predecessor left.

    Or every one from ``start`` on, whose predecessor left ``state``.

    Raises what DepthEngine.open_offline and step_offline raise; LayoutError: a file cannot be read.
    """
    stream = await engine.open_offline(config, state=state)
    frames = read_ahead(source, start=start)
    waiting: deque[asyncio.Task[Stepped]] = deque()
    try:
        async for index, frame in frames:
            if len(waiting) == _IN_FLIGHT:
                yield await waiting.popleft()
            waiting.append(asyncio.create_task(_step(engine, stream, index, frame)))
        while waiting:
            yield await waiting.popleft()
    finally:
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, frames.aclose(), return_exceptions=True)


async def _step(engine: DepthEngine, stream: Stream, index: int, source: SourceFrame) -> Stepped:
    disparity, state = await engine.step_offline(stream, lambda: source.frame)
    return Stepped(index, source, disparity, state)
