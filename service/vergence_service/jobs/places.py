"""A bounded queue of callers: one works, some wait, and any other is refused."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from vergence_proto.errors import QueueFull

# The expected duration of the work before any has been done.
_USUAL_S = 1.0


class Places:
    """Admits ``places`` callers, of which one works at a time, in the order in which they came."""

    def __init__(self, places: int) -> None:
        self._places = places
        self._taken = 0
        self._working = asyncio.Lock()  # wakes its waiters in order
        self._last_s = _USUAL_S

    def __len__(self) -> int:
        """Return the number of callers that work or wait."""
        return self._taken

    def check(self) -> None:
        """Raise QueueFull if there is no place now."""
        if self._taken >= self._places:
            raise QueueFull(
                f"{self._taken} pairs wait or are stepped, the limit of the server "
                "(limits.pairs); try again later",
                retry_after_s=self._last_s,
            )

    @asynccontextmanager
    async def taken(self) -> AsyncIterator[None]:
        """Take a place, and run the block when it is the caller's turn. Raises QueueFull."""
        self.check()
        self._taken += 1
        try:
            async with self._working:
                began_s = time.monotonic()
                yield
                self._last_s = time.monotonic() - began_s
        finally:
            self._taken -= 1
