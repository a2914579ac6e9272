"""Connect to a server that may not answer: attempts overlap, and the first connection wins."""

import asyncio
import random
from collections.abc import Callable, Iterator

from vergence.transports.base import Call, ClientClosed, ConnectionLost, Transport

# Three round trips at most: TCP, then TLS or HTTP/2, then the call.
_ATTEMPT_S = 5.0
# A lost SYN is repeated only after 1, 3 and 7 s, so new attempts start beside those that hang.
_FIRST_PAUSE_S, _LAST_PAUSE_S = 0.05, 0.5
_AT_ONCE = 8


def pauses() -> Iterator[float]:
    """Yield the seconds to wait between attempts: they grow, and half of each is random.

    So clients that lost the same server do not all return at once.
    """
    pause_s = _FIRST_PAUSE_S
    while True:
        yield pause_s * random.uniform(0.5, 1.0)
        pause_s = min(2 * pause_s, _LAST_PAUSE_S)


async def dial(
    transport: Transport, stream_id: str, *, failed: Callable[[ConnectionLost], None]
) -> Call:
    """Connect and start a call; try until it succeeds, or until the caller cancels.

    ``failed`` is called with the reason of each attempt that failed. Raises any other error.
    """
    attempts: set[asyncio.Task[Call]] = set()
    pause: asyncio.Task[None] | None = None
    waits = pauses()
    try:
        while True:
            if pause is None or pause.done():
                if len(attempts) < _AT_ONCE:
                    attempts.add(asyncio.create_task(_attempt(transport, stream_id)))
                pause = asyncio.create_task(asyncio.sleep(next(waits)))
            await asyncio.wait({*attempts, pause}, return_when=asyncio.FIRST_COMPLETED)
            for attempt in [each for each in attempts if each.done()]:
                attempts.discard(attempt)
                try:
                    return attempt.result()
                except ClientClosed:
                    raise
                except ConnectionLost as lost:
                    failed(lost)
    finally:
        if pause is not None:
            pause.cancel()
        await _abandon(attempts)


async def _attempt(transport: Transport, stream_id: str) -> Call:
    try:
        async with asyncio.timeout(_ATTEMPT_S):
            return await transport.open_call(stream_id)
    except TimeoutError:
        raise ConnectionLost(f"the server could not be reached in {_ATTEMPT_S:g} s") from None


async def _abandon(attempts: set[asyncio.Task[Call]]) -> None:
    for attempt in attempts:
        attempt.cancel()
    for outcome in await asyncio.gather(*attempts, return_exceptions=True):
        if not isinstance(outcome, BaseException):  # it connected in the same moment
            await outcome.close()
