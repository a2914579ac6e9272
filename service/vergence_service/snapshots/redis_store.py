"""Snapshots in Redis: one hash for each stream.

Scripts make every change, because only they can compare the owner and write in one step. The epoch
is Redis's own time in microseconds, or one above the stored epoch. So epochs grow even if the
values are lost meanwhile, and a server that was suspended cannot overwrite its successor.
"""

import asyncio
from typing import Any

from redis.asyncio import BlockingConnectionPool, Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from vergence_service.snapshots.store import (
    Claim,
    Claimed,
    OwnedByOther,
    Owner,
    Saved,
    StoreUnavailable,
)

_PREFIX = "vergence:stream:"
_CONNECTIONS = 16

_NEXT_EPOCH = """
local function next_epoch(stored)
  local now = redis.call('TIME')
  return math.max(tonumber(now[1]) * 1000000 + tonumber(now[2]), stored + 1)
end
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'token', 'rig')
local stored = tonumber(found[1] or '0')
"""

_SAVE = (
    _NEXT_EPOCH
    + """
local epoch = tonumber(ARGV[2])
if found[2] == ARGV[1] then
  epoch = stored
elseif epoch == 0 then
  if stored > 0 and ARGV[3] == '0' then return 0 end
  epoch = next_epoch(stored)
elseif epoch <= stored then
  return 0
end
redis.call('HSET', KEYS[1], 'epoch', string.format('%.0f', epoch), 'owner', ARGV[1],
           'token', ARGV[4], 'rig', ARGV[5], 'value', ARGV[6])
redis.call('PEXPIRE', KEYS[1], ARGV[7])
return epoch
"""
)

_CLAIM = (
    _NEXT_EPOCH
    + """
if not found[1] then return {0} end
if found[3] ~= ARGV[2] then return {-1} end
if found[4] ~= ARGV[3] then return {-2} end
if found[2] == ARGV[1] then return {1} end
local epoch = next_epoch(stored)
redis.call('HSET', KEYS[1], 'epoch', string.format('%.0f', epoch), 'owner', ARGV[1])
return {epoch, redis.call('HGET', KEYS[1], 'value')}
"""
)

_DISCARD = """
if redis.call('HGET', KEYS[1], 'owner') == ARGV[1] then return redis.call('DEL', KEYS[1]) end
return 0
"""

_REFUSED = {0: Claim.UNKNOWN, 1: Claim.OURS, -1: Claim.WRONG_TOKEN, -2: Claim.OTHER_RIG}


class RedisStore:
    """The :class:`~vergence_service.snapshots.store.SnapshotStore` at a Redis URL.

    ``timeout_s`` is the most that one call takes.
    """

    def __init__(self, url: str, *, timeout_s: float) -> None:
        pool = BlockingConnectionPool.from_url(
            url,
            max_connections=_CONNECTIONS,
            timeout=timeout_s,
            socket_connect_timeout=timeout_s,
            socket_timeout=timeout_s,
            retry=Retry(NoBackoff(), 0),  # the saver tries again, with a newer value
        )
        self._timeout_s = timeout_s
        self._redis = Redis.from_pool(pool)
        self._save = self._redis.register_script(_SAVE)
        self._claim = self._redis.register_script(_CLAIM)
        self._discard = self._redis.register_script(_DISCARD)

    async def save(self, saved: Saved, owner: Owner, *, takes_over: bool) -> int:
        """Write a value; see the protocol."""
        values: list[str | int | bytes] = [
            owner.name,
            owner.epoch,
            int(takes_over),
            saved.token_digest,
            saved.rig_digest,
            saved.value,
            int(saved.keep_s * 1000),
        ]
        epoch = int(await self._run(self._save, saved.key, values))
        if epoch == 0:
            raise OwnedByOther
        return epoch

    async def claim(
        self, key: str, owner: Owner, *, token_digest: str, rig_digest: str
    ) -> Claimed | Claim:
        """Become the owner; see the protocol."""
        answer = await self._run(self._claim, key, [owner.name, token_digest, rig_digest])
        epoch = int(answer[0])
        return _REFUSED[epoch] if epoch in _REFUSED else Claimed(epoch, answer[1])

    async def discard(self, key: str, owner: Owner) -> None:
        """Remove the value; see the protocol."""
        await self._run(self._discard, key, [owner.name])

    async def close(self) -> None:
        """Close the connections."""
        await self._redis.aclose(close_connection_pool=True)

    # The client's types do not say that a script's call is awaitable.
    async def _run(self, script: Any, key: str, values: list[Any]) -> Any:
        try:
            async with asyncio.timeout(self._timeout_s):
                return await script(keys=[_PREFIX + key], args=values)
        except (RedisError, OSError, TimeoutError) as error:
            raise StoreUnavailable(str(error) or type(error).__name__) from None
