"""The threads of the server: one pool for live frames, and one for all other work.

asyncio's own pool is not used: uploads that are unpacked there would keep live frames waiting.
"""

import asyncio
import os
import sys
import threading
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Any, ParamSpec, Self, TypeVar

Args = ParamSpec("Args")
Result = TypeVar("Result")
Piece = TypeVar("Piece")

_BACKGROUND_THREADS = 2
# On Linux, a thread has a priority of its own. Background work gets about a third of a core that a
# live frame needs too. Much less would be harmful: a thread that holds Python's lock must run soon.
_BACKGROUND_NICENESS = 5
# Long work lets other work have its thread after this time.
_SLICE_S = 0.02
# Pieces wait in memory until they are used. Those of results are up to a megabyte large.
_MOST_PIECES = 16


async def to_the_end(work: Coroutine[Any, Any, Result]) -> Result:
    """Run work that must not stop half-way. If the caller is cancelled, it ends after the work."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait([task])
        raise


@dataclass(slots=True, eq=False)
class Cost:
    """Counts the processor's time for the work of one frame."""

    seconds: float = 0.0

    def of(self, work: Callable[Args, Result], *args: Args.args, **kwargs: Args.kwargs) -> Result:
        """Do work in this thread, and add the processor's time, also of work that fails."""
        started_s = time.thread_time()
        try:
            return work(*args, **kwargs)
        finally:
            self.seconds += time.thread_time() - started_s


class ThreadPool:
    """Threads for one kind of work, as long as the context lasts.

    Work in a thread cannot be interrupted, so every piece must be short. Long work is an iterator
    of pieces, for :meth:`iterate`.
    """

    def __init__(self, threads: int, *, name: str, niceness: int = 0) -> None:
        self._count = threads
        self._name = name
        self._niceness = niceness

    async def __aenter__(self) -> Self:
        self._threads = ThreadPoolExecutor(
            self._count, thread_name_prefix=self._name, initializer=self._lower_priority
        )
        # Start all threads now: their number says nothing about the work.
        together = threading.Barrier(self._count)
        await asyncio.gather(*(self.run(together.wait) for _ in range(self._count)))
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        await asyncio.to_thread(self._threads.shutdown)

    async def run(
        self, work: Callable[Args, Result], *args: Args.args, **kwargs: Args.kwargs
    ) -> Result:
        """Run a short piece of work in a thread, and return or raise what it does.

        If the caller is cancelled, this returns only after the work has ended or was discarded: it
        does not touch a file that the caller removes next.
        """
        begun = self._threads.submit(work, *args, **kwargs)
        try:
            return await asyncio.wrap_future(begun)
        except asyncio.CancelledError:
            if not begun.cancel():
                ended = asyncio.wrap_future(begun)
                await asyncio.wait([ended])
                ended.exception()  # nobody is left to raise it to
            raise

    async def iterate(self, pieces: Iterator[Piece]) -> AsyncGenerator[Piece, None]:
        """Yield the items of ``pieces``, which works in threads, in turn with other work.

        Closing this stops the work after its current piece, and closes ``pieces`` in a thread.
        """
        try:
            while True:
                taken, error = await self.run(_take, pieces)
                for piece in taken:
                    yield piece
                if isinstance(error, StopIteration):
                    return
                if error is not None:
                    raise error
        finally:
            close = getattr(pieces, "close", None)  # only generators have it
            if close is not None:
                await self.run(close)

    async def finish(self, pieces: Iterator[object]) -> None:
        """Do the work of ``pieces`` to its end, in turn with other work."""
        async for _ in self.iterate(pieces):
            pass

    def _lower_priority(self) -> None:
        if self._niceness and sys.platform == "linux":
            niceness = os.getpriority(os.PRIO_PROCESS, 0) + self._niceness
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def _take(pieces: Iterator[Piece]) -> tuple[list[Piece], Exception | None]:
    """Take pieces for one slice of time. The exception that ends them comes after the pieces."""
    taken: list[Piece] = []
    until_s = time.monotonic() + _SLICE_S
    try:
        while not taken or (time.monotonic() < until_s and len(taken) < _MOST_PIECES):
            taken.append(next(pieces))
    except Exception as error:  # StopIteration, or the failure of the work
        return taken, error
    return taken, None


class Threads:
    """All threads of one server, apart from those of the model and of gRPC.

    ``live`` decodes and encodes the frames of streams. ``background`` has fewer threads and a lower
    priority: it unpacks uploads, reads and writes files, and makes films.
    """

    def __init__(self, *, lanes: int) -> None:
        self.live = ThreadPool(max(lanes + 1, os.cpu_count() or 1), name="live")
        self.background = ThreadPool(
            _BACKGROUND_THREADS, name="background", niceness=_BACKGROUND_NICENESS
        )

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(self.live)
            await stack.enter_async_context(self.background)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()
