"""A bounded queue of callers: one works, some wait, and any other is refused."""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from vergence_proto.errors import QueueFull, Quota
from vergence_service.access.principals import Principal

# The expected duration of the work before any has been done.
_USUAL_S = 1.0


class Places:
    """Admits ``places`` callers, of which one works at a time, in the order in which they came.

    A principal that has shown a credential gets half of the places, so that others have some.
    """

    def __init__(self, places: int) -> None:
        self._places = places
        self._of_one = max(places // 2, 1)
        self._taken = 0
        self._by_owner: Counter[str] = Counter()
        self._working = asyncio.Lock()  # wakes its waiters in order
        self._last_s = _USUAL_S

    def __len__(self) -> int:
        """Return the number of callers that work or wait."""
        return self._taken

    def check(self, owner: Principal) -> None:
        """Raise QueueFull if there is no place now, and Quota if ``owner`` has too many."""
        if owner.proven and self._by_owner[owner.name] >= self._of_one:
            raise Quota(
                f"{self._by_owner[owner.name]} pairs of {owner.name} wait or are stepped, the "
                "limit of one principal; try again later (half of the server's setting "
                "limits.pairs)",
                retry_after_s=self._last_s,
            )
        if self._taken >= self._places:
            raise QueueFull(
                f"{self._taken} pairs wait or are stepped, the limit of the server "
                "(limits.pairs); try again later",
                retry_after_s=self._last_s,
            )

    @asynccontextmanager
    async def taken(self, owner: Principal) -> AsyncIterator[None]:
        """Take a place, and run the block when it is the caller's turn.

        Raises QueueFull and Quota.
        """
        self.check(owner)
        self._taken += 1
        self._by_owner[owner.name] += 1
        try:
            async with self._working:
                began_s = time.monotonic()
                yield
                self._last_s = time.monotonic() - began_s
        finally:
            self._taken -= 1
            self._by_owner -= Counter([owner.name])  # which drops a count of 0
