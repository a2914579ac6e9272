"""Receive an answer so that a lost connection costs only what was on its way (RFC 9110 ranges)."""

import http
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from vergence.jobs.requests import Query, Requests, checked

if TYPE_CHECKING:  # an extra
    import httpx

Write = Callable[[int, bytes], Awaitable[None]]


async def fetch(requests: Requests, path: str, write: Write, *, query: Query | None = None) -> None:
    """Receive an answer; ``write`` gets the offset of each piece, which is 0 after a new beginning.

    Raises what the server answers, and ConnectionLost: it cannot be reached.
    """
    received, tag = 0, ""

    async def receive(answer: "httpx.Response") -> None:
        nonlocal received, tag
        if answer.status_code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and (
            answer.headers.get("Content-Range") == f"bytes */{received}"
        ):
            return  # the line was cut behind the last byte
        if answer.is_error:
            await answer.aread()
            checked(answer)
        if answer.status_code != http.HTTPStatus.PARTIAL_CONTENT:
            received = 0
        tag = answer.headers.get("ETag", "")
        async for chunk in answer.aiter_raw():
            await write(received, chunk)
            received += len(chunk)
            requests.moved()

    async def receive_rest() -> None:
        headers = {"Range": f"bytes={received}-", "If-Range": tag} if received and tag else {}
        async for answer in requests.stream(path, query=query or {}, headers=headers):
            await receive(answer)

    await requests.patiently(receive_rest)


async def fetch_bytes(requests: Requests, path: str) -> bytes:
    """Receive an answer that fits into memory; see :func:`fetch`."""
    content = bytearray()

    async def write(offset: int, chunk: bytes) -> None:
        content[offset:] = chunk

    await fetch(requests, path, write)
    return bytes(content)
