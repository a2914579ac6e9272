"""Wait for an event elsewhere."""

import asyncio
from collections.abc import Awaitable, Callable

PATIENCE_S = 20.0  # a test that hangs fails instead


async def eventually(condition: Callable[[], object]) -> None:
    """Wait until ``condition()`` is true. Use it for state that cannot notify, like a counter."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  nothing to wait on but the passing of time
            await asyncio.sleep(0.01)


async def eventually_true(condition: Callable[[], Awaitable[object]]) -> None:
    """Wait until ``await condition()`` is true."""
    async with asyncio.timeout(PATIENCE_S):
        while not await condition():  # noqa: ASYNC110  as above
            await asyncio.sleep(0.01)


async def turns(count: int = 50) -> None:
    """Let every task run as far as it can without new events. No wall clock decides."""
    for _ in range(count):
        await asyncio.sleep(0)
