"""The HTTP transport, for restricted networks: see :mod:`vergence_proto.http_records`."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any

import httpx
from google.protobuf.message import Message

from vergence.transports.addresses import on_this_machine
from vergence.transports.base import Answer, Call, ClientClosed, ConnectionLost
from vergence.transports.credentials import Credentials
from vergence.transports.proxies import through_proxy
from vergence_proto import codec
from vergence_proto.errors import DepthError, NotReady, error_from_wire
from vergence_proto.http_records import (
    ACCEPT_POST_HEADER,
    CALL_ID_HEADER,
    PROTOBUF_TYPE,
    RECORDS_TYPE,
    RecordKind,
    RecordReader,
    pack_record,
)
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import STREAM_ID_METADATA

_HEADERS = {"Content-Type": PROTOBUF_TYPE}
# A session pings every second, so the answer of a call is never silent for so long.
_TIMEOUT_S = 10.0


def http_client(server: str, **options: Any) -> httpx.AsyncClient:
    """Make a client of ``http://HOST:PORT``; on this machine, without the proxy of the environment.

    Raises ConnectionLost: the proxy that the environment names cannot be used.
    """
    try:
        return httpx.AsyncClient(base_url=server, trust_env=not on_this_machine(server), **options)
    except (ImportError, ValueError) as error:  # a SOCKS proxy without its package, or no URL
        raise ConnectionLost(f"no connection to {server}{through_proxy(server)}: {error}") from None


class HttpTransport:
    """The :class:`~vergence.transports.base.Transport` to ``http://HOST:PORT`` (or https)."""

    def __init__(self, base_url: str, *, credentials: Credentials | None = None) -> None:
        self._base_url = base_url
        shown = credentials or Credentials()
        self._shown = dict(shown.headers)
        self._tls = shown.tls()  # one for all connections: it takes 20 ms to make
        self._http = self._connections()
        self._calls: set[_HttpCall] = set()
        self._long_uploads = True

    async def open_call(self, stream_id: str) -> Call:
        self._check_open()
        # Connections of its own, because those of another call may be dead without knowing it.
        call = _HttpCall(self._connections(), stream_id, long_upload=self._long_uploads)
        try:
            await call.connect()
        except BaseException:
            await call.close()
            raise
        self._calls.add(call)
        call.closed = self._closed
        return call

    def _closed(self, call: "_HttpCall") -> None:
        self._calls.discard(call)
        if call.unheard:  # perhaps a proxy waits for the end of a long upload
            self._long_uploads = not call.long_upload

    def _connections(self) -> httpx.AsyncClient:
        return http_client(
            self._base_url, timeout=_TIMEOUT_S, verify=self._tls, headers=self._shown
        )

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        self._check_open()
        content = request.SerializeToString()
        stream_id = getattr(request, "stream_id", "")  # leads to the server of the stream
        headers = {**_HEADERS, STREAM_ID_METADATA: stream_id} if stream_id else _HEADERS
        try:
            response = await self._http.post(
                f"/v1/methods/{method}", content=content, headers=headers
            )
        except httpx.TransportError as error:
            raise _lost(self._http, error) from None
        if response.is_error:
            raise _error_of(response)
        return answer.FromString(response.content)

    async def close(self) -> None:
        await self._http.aclose()
        for call in list(self._calls):
            await call.close()

    def _check_open(self) -> None:
        if self._http.is_closed:
            raise ClientClosed


class _HttpCall:
    def __init__(self, http: httpx.AsyncClient, stream_id: str, *, long_upload: bool) -> None:
        self.long_upload = long_upload
        self.unheard = False  # something was sent after the opening, and nothing has come since
        self.closed: Callable[[_HttpCall], None] = _nothing
        self._http = http
        self._headers = {**_HEADERS, STREAM_ID_METADATA: stream_id}
        self._answer: httpx.Response | None = None
        self._pieces: AsyncIterator[bytes]
        self._reader = RecordReader()
        self._records: deque[tuple[RecordKind, bytes]] = deque()
        self._error: DepthError | None = None  # for receive to raise
        self._upload: asyncio.Task[None] | None = None
        self._to_upload: asyncio.Queue[bytes] = asyncio.Queue(1)
        self._heard = 0

    async def connect(self) -> None:
        """Connect; the answer does not matter, and the call uses the same connection."""
        try:
            await self._http.options("/v1/streams")
        except httpx.TransportError as error:
            raise _lost(self._http, error) from None

    async def send(self, request: bytes) -> None:
        try:
            if self._answer is None:
                await self._open(request)
            elif self._error is None:
                self.unheard = self._heard <= 1
                await self._send(request, self._answer.headers)
        except httpx.TransportError as error:
            self._error = _lost(self._http, error)

    async def receive(self) -> pb.StreamDepthResponse | None:
        if self._answer is None:
            raise self._error or ConnectionLost("nothing was sent")
        try:
            while not self._records:
                if self._error is not None:
                    raise self._error
                self._records.extend(self._reader.feed(await anext(self._pieces)))
        except StopAsyncIteration:
            raise ConnectionLost(f"{self._http.base_url} broke off its answer") from None
        except (httpx.TransportError, httpx.StreamError) as error:
            raise _lost(self._http, error) from None
        kind, content = self._records.popleft()
        self._heard += 1
        self.unheard = self.unheard and self._heard <= 1
        if kind is RecordKind.MESSAGE:
            return pb.StreamDepthResponse.FromString(content)
        if content:
            raise codec.error_from_frame_error(pb.FrameError.FromString(content))
        return None

    async def close(self) -> None:
        self._error = self._error or ConnectionLost("the call was closed")
        self.closed(self)
        if self._upload is not None:
            self._upload.cancel()
            await asyncio.gather(self._upload, return_exceptions=True)
        if self._answer is not None:
            await self._answer.aclose()
        await self._http.aclose()

    async def _send(self, request: bytes, opened: httpx.Headers) -> None:
        # Errors of these requests arrive in the call's own answer.
        path = f"/v1/streams/{opened[CALL_ID_HEADER]}"
        if not self.long_upload or RECORDS_TYPE not in opened.get(ACCEPT_POST_HEADER, ""):
            await self._http.post(path, content=request, headers=self._headers)
            return
        if self._upload is None:
            self._upload = asyncio.create_task(self._upload_all(path), name="vergence upload")
        queued = asyncio.create_task(self._to_upload.put(pack_record(RecordKind.MESSAGE, request)))
        try:
            await asyncio.wait([queued, self._upload], return_when=asyncio.FIRST_COMPLETED)
        finally:
            queued.cancel()
        if self._upload.done():
            self._upload.result()

    async def _upload_all(self, path: str) -> None:
        """Send what is queued in one request; it ends when the server has ended the call."""

        async def records() -> AsyncIterator[bytes]:
            while True:
                yield await self._to_upload.get()

        headers = {**self._headers, "Content-Type": RECORDS_TYPE}
        await self._http.post(path, content=records(), headers=headers)

    async def _open(self, request: bytes) -> None:
        post = self._http.build_request(
            "POST", "/v1/streams", content=request, headers=self._headers
        )
        answer = await self._http.send(post, stream=True)
        if answer.is_error:
            await answer.aread()
            self._error = _error_of(answer)
        self._answer = answer
        self._pieces = answer.aiter_raw()


def _nothing(call: _HttpCall) -> None:
    """Do nothing: the call is in no list yet."""


def _lost(http: httpx.AsyncClient, error: Exception) -> ConnectionLost:
    through = _through(http)
    return ConnectionLost(
        f"no connection to {http.base_url}{through} ({type(error).__name__}): {error}"
    )


def _through(http: httpx.AsyncClient) -> str:
    return through_proxy(str(http.base_url)) if http.trust_env else ""


def _error_of(response: httpx.Response) -> DepthError:
    """Return the error that the server raised, by its reason; no reason: another server."""
    if response.headers.get("Content-Type") == "application/problem+json":
        problem = response.json()
        if "reason" in problem:
            retry_after = response.headers.get("Retry-After")
            retry_after_s = None if retry_after is None else float(retry_after)
            return error_from_wire(problem["reason"], problem["detail"], retry_after_s)
    return NotReady(
        f"{response.url} answered {response.status_code} {response.reason_phrase}: "
        f"it speaks HTTP but does not offer Vergence streams{through_proxy(str(response.url))}"
    )
