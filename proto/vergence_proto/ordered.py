"""Run a bounded number of tasks on a stream of items, and take the results in order."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


async def in_order(
    items: AsyncIterable[_Item],
    work: Callable[[_Item], Awaitable[_Result]],
    *,
    limit: int,
    cancel_rest: bool = True,
) -> AsyncGenerator[_Result, None]:
    """Yield ``work(item)`` for every item, in the order of the items, ``limit`` at a time.

    The next item is only taken when fewer than ``limit`` results are outstanding. Closing the
    generator cancels the outstanding tasks, or with ``cancel_rest=False`` waits for them, since a
    task that waits for a thread cannot stop the thread. ``items`` is not closed; its owner does
    that. Exceptions of ``items`` and ``work`` pass through.
    """
    outstanding: deque[asyncio.Future[_Result]] = deque()
    try:
        async for item in items:
            if len(outstanding) == limit:
                yield await outstanding.popleft()
            outstanding.append(asyncio.ensure_future(work(item)))
        while outstanding:
            yield await outstanding.popleft()
    finally:
        if cancel_rest:
            for task in outstanding:
                task.cancel()
        await asyncio.gather(*outstanding, return_exceptions=True)
