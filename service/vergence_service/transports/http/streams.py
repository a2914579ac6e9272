"""The routes of live streams over HTTP, for networks that block gRPC.

:mod:`vergence_proto.http_records` defines the format.
"""

import asyncio
import secrets
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import StreamingResponse
from google.protobuf.message import Message

from vergence_proto import codec
from vergence_proto.codec.requests import MAX_SMALL_BYTES
from vergence_proto.errors import BadShape, DepthError, FrameTooLarge, UnknownStream
from vergence_proto.http_records import (
    ACCEPT_POST_HEADER,
    CALL_ID_HEADER,
    PROTOBUF_TYPE,
    RECORDS_TYPE,
    RecordKind,
    pack_record,
)
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import Principal
from vergence_service.process.failures import error_of
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.bodies import body_of, messages_of
from vergence_service.transports.http.errors import PROBLEM_RESPONSE, log
from vergence_service.transports.http.uploads import client_of
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.stream_call import ClientLost
from vergence_service.transports.unary import UnaryMethods

_BESIDE_IMAGES = 4096  # the fields of a frame that are no images

_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {PROTOBUF_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}
_CALL_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            each: {"schema": {"type": "string", "format": "binary"}}
            for each in (PROTOBUF_TYPE, RECORDS_TYPE)
        },
    }
}
_Method = Callable[[Request], Coroutine[Any, Any, Message]]


def stream_routes(
    calls: OpenCalls, unary: UnaryMethods, *, patience_s: float, min_bytes_per_s: float
) -> APIRouter:
    """Make the routes. A body that comes too slowly is refused."""

    async def body(
        request: Request, limit: int, *, received: Callable[[int], None] = _uncounted
    ) -> memoryview:
        chunks = body_of(request, patience_s=patience_s, min_bytes_per_s=min_bytes_per_s)
        return await _collected(chunks, limit, received)

    def method(
        question: type[Any], answer: Callable[[Any, Principal], Coroutine[Any, Any, Message]]
    ) -> _Method:
        async def ask(request: Request) -> Message:
            message = codec.read_small(question, await body(request, MAX_SMALL_BYTES))
            return await answer(message, CALLER.get())

        return ask

    router = APIRouter(tags=["streams"], responses=PROBLEM_RESPONSE)
    open_calls: dict[str, _HttpCall] = {}
    methods: dict[str, _Method] = {
        "GetServerInfo": method(pb.GetServerInfoRequest, unary.server_info),
        "GetStream": method(pb.GetStreamRequest, unary.stream),
        "ResetStream": method(pb.ResetStreamRequest, unary.reset),
        "CloseStream": method(pb.CloseStreamRequest, unary.close),
    }

    @router.post(
        "/v1/streams",
        response_class=StreamingResponse,
        openapi_extra=_BODY,
        responses={200: {"content": {RECORDS_TYPE: {"schema": {"type": "string"}}}}},
    )
    async def open_stream(request: Request) -> StreamingResponse:
        """Open or resume a stream with a StreamDepthRequest. The answers come as records."""
        call = _HttpCall(calls, client=client_of(request), caller=CALLER.get())
        first = await call.begin(codec.read_request(await body(request, MAX_SMALL_BYTES)))
        open_calls[call.call_id] = call

        async def records() -> AsyncIterator[bytes]:
            try:
                yield first
                async for record in call.records():
                    yield record
            finally:
                del open_calls[call.call_id]
                await call.leave()

        return StreamingResponse(
            records(),
            media_type=RECORDS_TYPE,
            headers={
                CALL_ID_HEADER: call.call_id,
                ACCEPT_POST_HEADER: f"{PROTOBUF_TYPE}, {RECORDS_TYPE}",
            },
        )

    @router.post("/v1/streams/{call_id}", status_code=204, openapi_extra=_CALL_BODY)
    async def send(call_id: str, request: Request) -> None:
        """Send one StreamDepthRequest to an open call, or many as records.

        The answer comes when the call has accepted them all.
        """
        if call_id not in open_calls or open_calls[call_id].caller.name != CALLER.get().name:
            raise UnknownStream("no open call has this id; open or resume the stream")
        call = open_calls[call_id]
        kind = request.headers["content-type"].partition(";")[0].strip().lower()
        try:
            await (
                call.until_end(many(call, request)) if kind == RECORDS_TYPE else one(call, request)
            )
        except DepthError as error:
            call.end(error)  # the client would wait for an answer to this message for ever
            raise

    limit = calls.limits.max_frame_bytes + _BESIDE_IMAGES

    async def one(call: _HttpCall, request: Request) -> None:
        with calls.memory.hold_frame(0) as memory:  # many may send at once to one call
            message = await body(request, limit, received=memory.grow)
            await call.put(codec.read_request(message))

    async def many(call: _HttpCall, request: Request) -> None:
        messages = messages_of(
            request,
            limit=limit,
            memory=calls.memory,
            patience_s=patience_s,
            min_bytes_per_s=min_bytes_per_s,
        )
        async for message in messages:
            await call.put(codec.read_request(message))

    @router.post(
        "/v1/methods/{method}",
        response_class=Response,
        openapi_extra=_BODY,
        responses={200: {"content": {PROTOBUF_TYPE: {"schema": {"type": "string"}}}}},
    )
    async def ask(
        request: Request,
        name: str = Path(
            alias="method", description="a name in depth.proto, for example GetServerInfo"
        ),
    ) -> Response:
        """Call a unary method of DepthService."""
        if name not in methods:
            raise BadShape(f"expected one of {', '.join(methods)}, got {name[:64]!r}")
        answer = await methods[name](request)
        return Response(answer.SerializeToString(), media_type=PROTOBUF_TYPE)

    return router


class _HttpCall:
    """Translates between requests and a DepthCall."""

    def __init__(self, calls: OpenCalls, *, client: str, caller: Principal) -> None:
        self.caller = caller
        self.call_id = secrets.token_urlsafe(16)
        self._client = client
        self._calls = calls
        # Room for one each: the faster side waits for the slower, as on a full connection.
        self._incoming: asyncio.Queue[codec.Request] = asyncio.Queue(1)
        self._outgoing: asyncio.Queue[bytes | None] = asyncio.Queue(1)  # None: nothing follows
        self._ended = asyncio.Event()
        self._opened = False
        self._refusal: DepthError | None = None  # the error of the opening

    async def begin(self, opening: codec.Request) -> bytes:
        """Start the call; return the first record of its answer. Raises the opening's error."""
        self._call = self._calls.make(
            self._requests(opening), self._write, client=self._client, caller=self.caller
        )
        self._task = asyncio.create_task(self._run(), name="HTTP call")
        first = await self._outgoing.get()
        if self._refusal is not None:
            raise self._refusal
        assert first is not None  # the opening is answered before a client can be lost
        return first

    async def put(self, message: codec.Request) -> None:
        ended = asyncio.create_task(self._ended.wait())
        put = asyncio.create_task(self._incoming.put(message))
        try:
            await asyncio.wait([ended, put], return_when=asyncio.FIRST_COMPLETED)
        finally:
            ended.cancel()
            put.cancel()

    async def until_end(self, upload: Coroutine[Any, Any, None]) -> None:
        """Take what a long request brings, until it or the call ends."""
        ended = asyncio.create_task(self._ended.wait())
        taking = asyncio.create_task(upload)
        try:
            await asyncio.wait([ended, taking], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (ended, taking):
                task.cancel()
        await asyncio.wait([taking])
        if not taking.cancelled():
            taking.result()

    def end(self, error: DepthError) -> None:
        self._call.end(error)

    async def records(self) -> AsyncIterator[bytes]:
        while not (self._ended.is_set() and self._outgoing.empty()):
            if (record := await self._outgoing.get()) is None:
                return
            yield record

    async def leave(self) -> None:
        """End the call: the client is gone or has every answer. The stream may be resumed."""
        self._ended.set()  # a message that waits to be accepted waits no longer
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        end: bytes | None = b""  # None: no end record; to the client, the answer breaks off
        try:
            await self._calls.run(self._call)
        except ClientLost as lost:
            log.info("a call over HTTP counts as lost: %s", lost)
            if not self._outgoing.empty():
                self._outgoing.get_nowait()
            end = None
        except Exception as error:
            end = self._end_record(error_of(error, log, "a call"))
        # Not in a ``finally``: if the call was cancelled, no client is left to report to.
        await self._outgoing.put(None if end is None else pack_record(RecordKind.END, end))
        self._ended.set()

    def _end_record(self, error: DepthError) -> bytes:
        if not self._opened:
            self._refusal = error
        return codec.error_to_frame_error(0, error).SerializeToString()

    async def _requests(self, opening: codec.Request) -> AsyncIterator[codec.Request]:
        yield opening
        while True:
            yield await self._incoming.get()

    async def _write(self, response: pb.StreamDepthResponse) -> None:
        self._opened = True
        await self._outgoing.put(pack_record(RecordKind.MESSAGE, response.SerializeToString()))


def _uncounted(nbytes: int) -> None:
    """Count nothing, for small bodies."""


async def _collected(
    chunks: AsyncIterator[bytes], limit: int, received: Callable[[int], None]
) -> memoryview:
    """Collect the body of a request, and call ``received`` with the size of each piece.

    Raises FrameTooLarge if it has more than ``limit`` bytes, and what ``received`` raises.
    """
    body = bytearray()
    async for chunk in chunks:
        body += chunk
        if len(body) > limit:
            raise FrameTooLarge(
                f"expected a message of at most {limit} bytes; the server's setting "
                "limits.max_frame_mib allows more"
            )
        received(len(chunk))
    return memoryview(body)
