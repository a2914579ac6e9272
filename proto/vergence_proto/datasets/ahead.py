"""Frames of a source for an event loop: the next is read while the last is in use."""

import asyncio
from collections.abc import AsyncGenerator, Iterator

from vergence_proto.datasets.source import SourceFrame, StereoSource


async def read_ahead(
    source: StereoSource, *, start: int = 0
) -> AsyncGenerator[tuple[int, SourceFrame], None]:
    """Index from ``start`` and frame, each decoded in a thread while the one before is in use.

    Raises LayoutError: a file cannot be read.
    """
    frames: Iterator[SourceFrame] = (source[index] for index in range(start, len(source)))
    coming = asyncio.create_task(asyncio.to_thread(next, frames, None))
    index = start
    try:
        while (frame := await coming) is not None:
            coming = asyncio.create_task(asyncio.to_thread(next, frames, None))
            yield index, frame
            index += 1
    finally:
        await asyncio.gather(coming, return_exceptions=True)
