"""Read the frames of a source for an event loop, one frame ahead."""

import asyncio
from collections.abc import AsyncGenerator, Iterator

from vergence_proto.datasets.source import SourceFrame, StereoSource


async def read_ahead(
    source: StereoSource, *, start: int = 0
) -> AsyncGenerator[tuple[int, SourceFrame], None]:
    """Yield index and frame from ``start`` on; decode the next frame while one is in use.

    Decoding runs in a thread. Raises DatasetError: a file cannot be read.
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
