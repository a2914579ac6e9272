"""Requests about jobs and uploads of another server: they are passed on to it.

A job lives on the disk of the server that accepted it. Behind a front, any server may be asked for
it. That server looks up who has the job, and passes the request on with its credential, which the
other server checks; so nothing is copied, and no server needs the disk of another.
"""

import asyncio
import logging
import re
import ssl
from collections.abc import AsyncIterator, Sequence
from typing import Self
from urllib.parse import parse_qs

import httpx
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vergence_proto.errors import BadShape, NotReady
from vergence_service.jobs.directory import DirectoryUnavailable, JobDirectory
from vergence_service.jobs.queue import JobQueue
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import refusal_of
from vergence_service.transports.http.idempotency import Submission

log = logging.getLogger(__name__)

_KEPT = re.compile(r"/v1/(?:sequences|uploads)/([0-9a-f]{32})(?:/.*)?")
_ID = re.compile("[0-9a-f]{32}")  # of a job or an upload; a key has a space
_SUBMISSIONS = "/v1/sequences"
_PASSED_ON = "vergence-passed-on"  # a request goes one step: its server answers it
_RENEW_S = 30.0
_RETRY_S = 5.0
_CONNECT_S = 2.0
_CONNECTIONS = 64
# Those of one connection, those that the other server would take for its own, and those that the
# border of this server has checked.
_NOT_ASKED = {
    *(b"connection", b"keep-alive", b"te", b"trailer", b"transfer-encoding", b"upgrade"),
    *(b"host", b"expect", b"origin", b"cookie", b"sec-fetch-site"),
}
_NOT_ANSWERED = {b"connection", b"keep-alive", b"transfer-encoding", b"date", b"server"}


class _ClientGone(Exception):
    """The client has disconnected."""


class OtherServers:
    """An ASGI application: ``app``, and for jobs that it does not have, other servers.

    ``address`` is the URL under which they reach this one. Use it inside ``async with``.
    """

    def __init__(
        self, app: ASGIApp, queue: JobQueue, *, directory: JobDirectory, address: str
    ) -> None:
        self._app = app
        self._queue = queue
        self._directory = directory
        self._address = address
        self._failed = False  # the directory could not be written; the log says so

    async def __aenter__(self) -> Self:
        self._http = httpx.AsyncClient(
            timeout=httpx.Timeout(None, connect=_CONNECT_S),  # an answer may wait for a job
            limits=httpx.Limits(max_connections=_CONNECTIONS),
            verify=ssl.create_default_context(),  # the system's authorities, or SSL_CERT_FILE
            trust_env=False,
        )
        self._renewing = asyncio.create_task(self._renew())
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._renewing.cancel()
        await asyncio.gather(self._renewing, return_exceptions=True)
        await self._http.aclose()
        await self._directory.close()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        names = _names_of(scope)
        try:
            passed_on = _PASSED_ON in Headers(scope=scope)
            address = None if passed_on else await self._server_of(names)
        except DirectoryUnavailable:
            refusal = NotReady(
                "this server does not have it, and cannot look up which server does",
                retry_after_s=_RETRY_S,
            )
            await refusal_of(refusal)(scope, receive, send)
            return
        if address is not None:
            await self._pass_on(address, scope, receive, send)
        elif scope["method"] == "POST":
            await self._app(scope, receive, self._noting(names, send))
        else:
            await self._app(scope, receive, send)

    async def _server_of(self, names: Sequence[str]) -> str | None:
        """Return the address of another server that has one of these; None: this one answers."""
        for name in names:
            if not await self._queue.has(name):
                address = await self._directory.find(name)
                if address not in (None, self._address):
                    return address
        return None

    def _noting(self, names: Sequence[str], send: Send) -> Send:
        """Note what a request has made, before its client hears of it."""

        async def send_noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                location = Headers(raw=message["headers"]).get("location", "")
                if made := _KEPT.fullmatch(location):
                    keys = [name for name in names if not _ID.fullmatch(name)]
                    await self._note([made[1], *keys])
            await send(message)

        return send_noted

    async def _note(self, names: Sequence[str]) -> None:
        try:
            await self._directory.note(names, self._address)
        except DirectoryUnavailable as error:
            if not self._failed:
                log.warning(
                    "other servers cannot be told of the jobs of this one: %s. They answer for its "
                    "jobs again when they can",
                    error,
                )
            self._failed = True
        else:
            self._failed = False

    async def _renew(self) -> None:
        """Note all that is here: for a directory that was emptied, and a server that has moved."""
        while True:
            if names := await self._queue.names():
                await self._note(names)
            await asyncio.sleep(_RENEW_S)

    async def _pass_on(self, address: str, scope: Scope, receive: Receive, send: Send) -> None:
        query = b"?" + scope["query_string"] if scope["query_string"] else b""
        path = (scope.get("raw_path") or scope["path"].encode()) + query
        headers = [(name, value) for name, value in scope["headers"] if name not in _NOT_ASKED]
        request = self._http.build_request(
            scope["method"],
            httpx.URL(address).copy_with(raw_path=path),
            headers=[*headers, (_PASSED_ON.encode(), b"1")],
            content=_body_of(receive) if _has_body(scope) else None,
        )
        answering = asyncio.create_task(self._answer(request, scope, send))
        gone = asyncio.create_task(_until_gone(receive)) if not _has_body(scope) else None
        try:
            await asyncio.wait(
                [answering, gone] if gone else [answering], return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            for task in (answering, gone):
                if task is not None and not task.done():
                    task.cancel()
            await asyncio.gather(
                *(task for task in (answering, gone) if task), return_exceptions=True
            )
        if not answering.cancelled():
            answering.result()

    async def _answer(self, request: httpx.Request, scope: Scope, send: Send) -> None:
        try:
            answer = await self._http.send(request, stream=True)
        except _ClientGone:
            return
        except httpx.TransportError as error:
            log.info("the server %s does not answer for its jobs: %s", request.url.host, error)
            refusal = NotReady(
                "the server that has it cannot be reached; it is not lost, try again later",
                retry_after_s=_RETRY_S,
            )
            await refusal_of(refusal)(scope, _nothing, send)
            return
        try:
            headers = [each for each in answer.headers.raw if each[0].lower() not in _NOT_ANSWERED]
            await send(
                {
                    "type": "http.response.start",
                    "status": answer.status_code,
                    "headers": [(name.lower(), value) for name, value in headers],
                }
            )
            # If it breaks off, the client's connection ends before the answer does.
            async for chunk in answer.aiter_raw():
                await send({"type": "http.response.body", "body": chunk, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
        finally:
            await answer.aclose()


def _names_of(scope: Scope) -> list[str]:
    """Return the names by which a request can be another server's: a key, and ids."""
    if kept := _KEPT.fullmatch(scope["path"]):
        return [kept[1]]
    if scope["path"] != _SUBMISSIONS or scope["method"] != "POST":
        return []
    names = []
    caller = CALLER.get()
    if caller.proven:  # the key of another caller belongs to its address
        try:
            key = Submission.of(Request(scope), caller).key
        except BadShape:
            key = ""  # the app refuses it
        names += [key] if key else []
    uploads = parse_qs(scope["query_string"].decode()).get("upload", [])
    return names + [each for each in uploads if _ID.fullmatch(each)]


def _has_body(scope: Scope) -> bool:
    headers = Headers(scope=scope)
    return "transfer-encoding" in headers or headers.get("content-length", "0") != "0"


async def _body_of(receive: Receive) -> AsyncIterator[bytes]:
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise _ClientGone
        yield message.get("body", b"")
        if not message.get("more_body"):
            return


async def _until_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


async def _nothing() -> Message:
    return {"type": "http.disconnect"}
