"""Run a bounded number of tasks on a stream of items, and take the results in order."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable, Collection
from typing import Any, TypeVar

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

    The next item is only taken when fewer than ``limit`` results are outstanding. If the generator
    is closed or its caller is cancelled, all outstanding tasks end before it does: they are
    cancelled, or with ``cancel_rest=False`` left to finish, since a task that waits for a thread
    cannot stop the thread. ``items`` is not closed; its owner does that. Exceptions of ``items``
    and ``work`` pass through.
    """
    outstanding: deque[asyncio.Future[_Result]] = deque()
    try:
        async for item in items:
            if len(outstanding) == limit:
                yield await _first(outstanding)
            outstanding.append(asyncio.ensure_future(work(item)))
        while outstanding:
            yield await _first(outstanding)
    finally:
        if cancel_rest:
            for task in outstanding:
                task.cancel()
        await _all_ended(outstanding)


async def _first(outstanding: deque[asyncio.Future[_Result]]) -> _Result:
    """Wait for the first task and take it out. Cancelling the caller does not cancel the task."""
    await asyncio.wait([outstanding[0]])
    return outstanding.popleft().result()


async def _all_ended(tasks: Collection[asyncio.Future[Any]]) -> None:
    """Wait until all tasks have ended, and only then let a cancellation through."""
    cancelled: asyncio.CancelledError | None = None
    while running := [task for task in tasks if not task.done()]:
        try:
            await asyncio.wait(running)
        except asyncio.CancelledError as error:
            cancelled = error
    for task in tasks:
        if not task.cancelled():
            task.exception()  # nobody is left to raise it to
    if cancelled is not None:
        raise cancelled
