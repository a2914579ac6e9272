"""Read the body of a request from a client that may be slow, silent or gone."""

import asyncio
from collections.abc import AsyncIterator

from fastapi import Request

from vergence_proto.errors import ClientTimeout


async def body_of(
    request: Request, *, patience_s: float, min_bytes_per_s: float
) -> AsyncIterator[bytes]:
    """Yield the chunks of a body. Raises ClientTimeout if they come too slowly.

    ``patience_s`` is the longest pause. A client that sends less than ``min_bytes_per_s`` uses it
    up little by little. Only the time in which the server waits for the client counts. Raises
    starlette's ClientDisconnect if the client disconnects.
    """
    loop = asyncio.get_running_loop()
    left_s = patience_s
    received = 0
    chunks = aiter(request.stream())
    while True:
        asked_s = loop.time()
        try:
            async with asyncio.timeout(left_s):
                chunk = await anext(chunks, None)
        except TimeoutError:
            raise ClientTimeout(
                f"the client sent too slowly: {received} bytes came, then less than "
                f"{min_bytes_per_s:.0f} bytes per second for {patience_s:g} s"
            ) from None
        if chunk is None:
            return
        received += len(chunk)
        waited_s = loop.time() - asked_s
        left_s = min(patience_s, left_s - waited_s + len(chunk) / min_bytes_per_s)
        yield chunk
