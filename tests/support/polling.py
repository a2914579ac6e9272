"""Waiting for what happens elsewhere."""

import asyncio
from collections.abc import Callable

PATIENCE_S = 20.0  # a test that hangs fails instead


async def eventually(condition: Callable[[], object]) -> None:
    """Until ``condition()`` is true. For what cannot announce itself, as a counter."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  nothing to wait on but the passing of time
            await asyncio.sleep(0.01)
