"""Limits on the requests to gRPC services that others wrote: health and reflection."""

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from vergence_proto.codec.requests import MAX_SMALL_BYTES
from vergence_proto.errors import BadShape, FrameTooLarge
from vergence_service.transports.grpc.errors import Context, errors_as_status

_Parse = Callable[[bytes], Any]
_Behaviour = Callable[[Any, Context], Any]


class SmallRequests(grpc.aio.ServerInterceptor):  # type: ignore[type-arg] # of its stubs only
    """Refuses large requests before protobuf reads them, and bytes that are no message.

    A handler that takes bytes, as those of DepthService do, has limits of its own.
    """

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        handler = await continuation(handler_call_details)
        if handler is None or handler.request_deserializer is None:
            return handler
        bounded = {
            kind: _bounded(
                behaviour, handler.request_deserializer, stream=kind.startswith("stream")
            )
            for kind in ("unary_unary", "unary_stream", "stream_stream")
            if (behaviour := getattr(handler, kind)) is not None
        }
        return handler._replace(request_deserializer=None, **bounded)


def _bounded(behaviour: _Behaviour, parse: _Parse, *, stream: bool) -> _Behaviour:
    def read(request: Any) -> Any:
        return _each_parsed(request, parse) if stream else _parsed(request, parse)

    async def answer(request: Any, context: Context) -> Any:
        async with errors_as_status(context):
            return await behaviour(read(request), context)

    async def answers(request: Any, context: Context) -> AsyncIterator[Any]:
        async with errors_as_status(context):
            async for each in behaviour(read(request), context):
                yield each

    return answers if inspect.isasyncgenfunction(behaviour) else answer


async def _each_parsed(requests: AsyncIterator[bytes], parse: _Parse) -> AsyncIterator[Any]:
    async for request in requests:
        yield _parsed(request, parse)


def _parsed(request: bytes, parse: _Parse) -> Any:
    if len(request) > MAX_SMALL_BYTES:
        raise FrameTooLarge(f"expected a request of at most {MAX_SMALL_BYTES} bytes")
    try:
        return parse(request)
    except DecodeError:
        raise BadShape("expected a message of this service, got other bytes") from None
