"""A deadline for the first message of every call, of whatever service."""

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from vergence_proto.errors import BadShape, ClientTimeout
from vergence_service.transports.grpc.errors import Context, abort


class FirstMessageDeadline(grpc.aio.ServerInterceptor):  # type: ignore[type-arg] # no generic
    """Ends a call whose client sends no message within ``within_s``.

    gRPC itself waits for the message of a unary call without a limit. So this handles every call as
    one with a stream of requests, which looks the same to clients.
    """

    def __init__(self, within_s: float) -> None:
        self._within_s = within_s

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """Return the handler of a call, with the deadline."""
        handler = await continuation(handler_call_details)
        if handler is None:  # no such method
            return handler
        make = (
            grpc.stream_stream_rpc_method_handler
            if handler.response_streaming
            else grpc.stream_unary_rpc_method_handler
        )
        return make(
            self._behaviour(handler), handler.request_deserializer, handler.response_serializer
        )

    def _behaviour(self, handler: Any) -> Callable[[AsyncIterator[Any], Context], Any]:
        behaviour = (
            handler.stream_stream
            or handler.stream_unary
            or handler.unary_stream
            or handler.unary_unary
        )

        async def request_of(requests: AsyncIterator[Any], context: Context) -> Any:
            first = await self._first(requests, context)
            return _chained(first, requests) if handler.request_streaming else first

        if inspect.isasyncgenfunction(behaviour):

            async def answers(requests: AsyncIterator[Any], context: Context) -> AsyncIterator[Any]:
                async for answer in behaviour(await request_of(requests, context), context):
                    yield answer

            return answers

        async def answer(requests: AsyncIterator[Any], context: Context) -> Any:
            return await behaviour(await request_of(requests, context), context)

        return answer

    async def _first(self, requests: AsyncIterator[Any], context: Context) -> Any:
        try:
            async with asyncio.timeout(self._within_s):
                return await anext(aiter(requests))
        except TimeoutError:
            await abort(
                context,
                ClientTimeout(f"expected the first message within {self._within_s:g} s"),
            )
        except StopAsyncIteration:
            await abort(context, BadShape("expected a message, got none"))
        except DecodeError:
            await abort(context, BadShape("expected a message of the method, got other bytes"))


async def _chained(first: Any, rest: AsyncIterator[Any]) -> AsyncIterator[Any]:
    yield first
    async for message in rest:
        yield message
