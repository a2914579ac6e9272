"""Read the body of a request from a client that may be slow, silent or gone."""

import asyncio
from collections.abc import AsyncIterator

from fastapi import Request

from vergence_proto.errors import BadShape, ClientTimeout, FrameTooLarge
from vergence_proto.http_records import RECORD_HEAD_BYTES, RecordKind, read_head
from vergence_service.process.memory import MemoryBudget


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
            raise _too_slow(received, patience_s, min_bytes_per_s) from None
        if chunk is None:
            return
        received += len(chunk)
        waited_s = loop.time() - asked_s
        left_s = min(patience_s, left_s - waited_s + len(chunk) / min_bytes_per_s)
        yield chunk


async def messages_of(
    request: Request,
    *,
    limit: int,
    memory: MemoryBudget,
    patience_s: float,
    min_bytes_per_s: float,
) -> AsyncIterator[memoryview]:
    """Yield the messages of a long body of records; the memory of each is held until the next.

    A message of which a part has come has the deadlines of :func:`body_of`. Between two messages
    there is none: the call itself notices a client that is silent.

    Raises BadShape if the body is no sequence of messages, FrameTooLarge if one has more than
    ``limit`` bytes, StateMemory, ClientTimeout, and starlette's ClientDisconnect.
    """
    loop = asyncio.get_running_loop()
    chunks = aiter(request.stream())
    buffer = bytearray()
    while True:
        with memory.hold_frame(len(buffer)) as held:
            left_s = patience_s
            while (end := _end_of_first(buffer, limit)) is None:
                begun, asked_s = bool(buffer), loop.time()
                try:
                    async with asyncio.timeout(left_s if begun else None):
                        chunk = await anext(chunks, None)
                except TimeoutError:
                    raise _too_slow(len(buffer), patience_s, min_bytes_per_s) from None
                if chunk is None:
                    if begun:
                        raise BadShape("expected whole records, and the body ended within one")
                    return
                held.grow(len(chunk))
                buffer += chunk
                waited_s = loop.time() - asked_s if begun else 0.0
                left_s = min(patience_s, left_s - waited_s + len(chunk) / min_bytes_per_s)
            message = bytes(memoryview(buffer)[RECORD_HEAD_BYTES:end])
            del buffer[:end]
            yield memoryview(message)


def _end_of_first(buffer: bytearray, limit: int) -> int | None:
    """Return where the first record ends; None: it is not whole."""
    if len(buffer) < RECORD_HEAD_BYTES:
        return None
    if buffer[0] != RecordKind.MESSAGE:
        raise BadShape(f"expected records of kind {RecordKind.MESSAGE}, got {buffer[0]}")
    _, length = read_head(buffer)
    if length > limit:
        raise FrameTooLarge(
            f"expected a message of at most {limit} bytes, got {length}; the server's setting "
            "limits.max_frame_mib allows more"
        )
    end = RECORD_HEAD_BYTES + length
    return end if len(buffer) >= end else None


def _too_slow(received: int, patience_s: float, min_bytes_per_s: float) -> ClientTimeout:
    return ClientTimeout(
        f"the client sent too slowly: {received} bytes came, then less than "
        f"{min_bytes_per_s:.0f} bytes per second for {patience_s:g} s"
    )
