"""Frames of a source for an event loop: the next is read while the last is in use."""

import asyncio
from collections.abc import AsyncGenerator, Iterator

from vergence_proto.layouts.source import SourceFrame, StereoSource


async def read_ahead(source: StereoSource) -> AsyncGenerator[tuple[int, SourceFrame], None]:
    """Index from 0 and frame, each decoded in a thread while the one before is in use.

    Raises LayoutError: a file cannot be read.
    """
    frames: Iterator[SourceFrame] = iter(source)
    coming = asyncio.create_task(asyncio.to_thread(next, frames, None))
    index = 0
    try:
        while (frame := await coming) is not None:
            coming = asyncio.create_task(asyncio.to_thread(next, frames, None))
            yield index, frame
            index += 1
    finally:
        await asyncio.gather(coming, return_exceptions=True)
