"""The directory of jobs in Redis: one string for each name, which expires."""

import asyncio
import hashlib
from collections.abc import Sequence

from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from vergence_service.jobs.directory import DirectoryUnavailable

_PREFIX = "vergence:job:"


class RedisDirectory:
    """The :class:`~vergence_service.jobs.directory.JobDirectory` at a Redis URL.

    A note lasts ``keep_s`` from the last time it was made. ``timeout_s`` is the most that one call
    takes.
    """

    def __init__(self, url: str, *, keep_s: float, timeout_s: float) -> None:
        self._keep_ms = round(1000 * keep_s)
        self._timeout_s = timeout_s
        self._redis = Redis.from_url(
            url,
            decode_responses=True,
            socket_connect_timeout=timeout_s,
            socket_timeout=timeout_s,
            retry=Retry(NoBackoff(), 0),
        )

    async def note(self, names: Sequence[str], address: str) -> None:
        """Note that the server at ``address`` has these."""
        try:
            async with (
                asyncio.timeout(self._timeout_s),
                self._redis.pipeline(transaction=False) as batch,
            ):
                for name in names:
                    batch.set(_key(name), address, px=self._keep_ms)
                await batch.execute()
        except (RedisError, OSError, TimeoutError) as error:
            raise DirectoryUnavailable(str(error) or type(error).__name__) from None

    async def find(self, name: str) -> str | None:
        """Return the address of the server that has it; None: nobody has noted it."""
        try:
            async with asyncio.timeout(self._timeout_s):
                found = await self._redis.get(_key(name))
        except (RedisError, OSError, TimeoutError) as error:
            raise DirectoryUnavailable(str(error) or type(error).__name__) from None
        return None if found is None else str(found)

    async def close(self) -> None:
        """Close the connections."""
        await self._redis.aclose(close_connection_pool=True)


def _key(name: str) -> str:
    # The id of a job can be all that protects it, so Redis does not see it.
    return _PREFIX + hashlib.sha256(name.encode()).hexdigest()
