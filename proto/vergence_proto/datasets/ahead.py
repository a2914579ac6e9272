"""Read the frames of a source for an event loop, one frame ahead."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from functools import partial

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.source import SourceFrame, StereoSource

_Read = tuple[SourceFrame | None, DatasetError | None]


async def read_ahead(
    source: StereoSource,
    *,
    start: int = 0,
    on_unreadable: Callable[[int, DatasetError], None] | None = None,
    on_read: Callable[[int, SourceFrame], None] = lambda index, frame: None,
    in_thread: Callable[[Callable[[], _Read]], Awaitable[_Read]] = asyncio.to_thread,
) -> AsyncGenerator[tuple[int, SourceFrame], None]:
    """Yield index and frame from ``start`` on; decode the next frame while one is in use.

    Decoding runs in a thread, by ``in_thread``. If a file is missing or damaged, ``on_unreadable``
    gets the frame's index and the error. A frame without its truth is yielded all the same; a frame
    that lacks an image is left out. Without ``on_unreadable``, raises DatasetError.

    ``on_read`` is called in the thread, with each frame that was read.
    """

    def read(index: int) -> _Read:
        found = decode(index)
        if found[0] is not None:
            on_read(index, found[0])
        return found

    def decode(index: int) -> _Read:
        try:
            return source[index], None
        except DatasetError as error:
            if on_unreadable is None:
                raise
            try:
                return source.without_truth()[index], error
            except DatasetError:
                return None, error

    count = len(source)
    coming = asyncio.ensure_future(in_thread(partial(read, start))) if start < count else None
    try:
        for index in range(start, count):
            assert coming is not None  # there is one before each frame
            (frame, error), coming = await coming, None
            if index + 1 < count:
                coming = asyncio.ensure_future(in_thread(partial(read, index + 1)))
            if error is not None and on_unreadable is not None:
                on_unreadable(index, error)
            if frame is not None:
                yield index, frame
    finally:
        if coming is not None:
            await asyncio.gather(coming, return_exceptions=True)
