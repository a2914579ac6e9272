"""Whatever ends a call or a stream, none is left: what was opened is closed."""

import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import grpc
import httpx
import pytest

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.http import http_to, metrics_of
from tests.support.models import RecallModel
from tests.support.polling import eventually_true
from tests.support.server import RawCall, running_server
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.app.server import Running
from vergence_service.process.memory import MemoryKind

PROTOBUF = {"content-type": "application/x-protobuf"}
OWN_CONNECTION = [("grpc.use_local_subchannel_pool", 1)]


@asynccontextmanager
async def streaming(server: Running) -> AsyncIterator[tuple[RawCall, grpc.aio.Channel]]:
    """A stream that has stepped a frame, on a connection of its own."""
    async with grpc.aio.insecure_channel(server.grpc_address, options=OWN_CONNECTION) as channel:
        call = RawCall(depth_pb2_grpc.DepthServiceStub(channel).StreamDepth())
        call.opened = (await call.ask(open_message())).opened
        await call.ask(frame_message(make_frame(1)))
        yield call, channel


async def says_the_end(server: Running) -> None:
    async with streaming(server) as (call, _):
        await call.send(pb.StreamDepthRequest(end=pb.End()))
        assert await call.receive() is None


async def cancels(server: Running) -> None:
    async with streaming(server) as (call, _):
        call.call.cancel()


async def cancels_while_its_frame_is_stepped(server: Running) -> None:
    async with streaming(server) as (call, _):
        await call.send(frame_message(make_frame(2)))
        call.call.cancel()


async def cuts_the_connection(server: Running) -> None:
    async with streaming(server) as (_, channel):
        await channel.close(None)


async def sends_an_empty_message(server: Running) -> None:
    async with streaming(server) as (call, _):
        await call.send(pb.StreamDepthRequest())
        with pytest.raises(grpc.aio.AioRpcError):
            await call.receive()


async def opens_twice(server: Running) -> None:
    async with streaming(server) as (call, _):
        await call.send(open_message())
        with pytest.raises(grpc.aio.AioRpcError):
            await call.receive()


async def never_opens(server: Running) -> None:
    async with grpc.aio.insecure_channel(server.grpc_address, options=OWN_CONNECTION) as channel:
        call = RawCall(depth_pb2_grpc.DepthServiceStub(channel).StreamDepth())
        with pytest.raises(grpc.aio.AioRpcError):
            await call.receive()


async def is_closed_by_another_call(server: Running) -> None:
    async with streaming(server) as (call, channel):
        stub = depth_pb2_grpc.DepthServiceStub(channel)
        await stub.CloseStream(
            pb.CloseStreamRequest(
                stream_id=call.opened.stream_id, resume_token=call.opened.resume_token
            )
        )


async def resumes_and_leaves(server: Running) -> None:
    async with streaming(server) as (call, channel):
        call.call.cancel()
        again = RawCall(depth_pb2_grpc.DepthServiceStub(channel).StreamDepth())
        resuming = open_message(call.opened.stream_id, resume_token=call.opened.resume_token)
        await again.ask(resuming)


async def cuts_http_in_the_middle(server: Running) -> None:
    body = open_message().SerializeToString()
    url = f"http://{server.http_address}/v1/streams"
    async with (
        httpx.AsyncClient() as client,
        client.stream("POST", url, content=body, headers=PROTOBUF) as answer,
    ):
        assert answer.status_code == 200
        await anext(answer.aiter_raw())


ENDINGS: list[Callable[[Running], Awaitable[None]]] = [
    says_the_end,
    cancels,
    cancels_while_its_frame_is_stepped,
    cuts_the_connection,
    sends_an_empty_message,
    opens_twice,
    never_opens,
    is_closed_by_another_call,
    resumes_and_leaves,
    cuts_http_in_the_middle,
]


async def test_what_was_opened_is_closed_whatever_ends_it() -> None:
    async with (
        running_server(
            RecallModel(),
            streams__detach_grace_s=0.1,
            limits__first_message_s=0.2,
        ) as server,
        http_to(server) as http,
    ):
        for ending in ENDINGS:
            await ending(server)

        async def balanced() -> bool:
            text = await metrics_of(http)
            names = ("streams_opened_total", "streams_closed_total", "calls_open", "streams_open")
            opened, closed, calls, streams = (
                sum(
                    float(value)
                    for value in re.findall(rf"^vergence_{name}(?:{{.*}})? (\S+)$", text, re.M)
                )
                for name in names
            )
            return opened == closed == len(ENDINGS) - 1 and calls == streams == 0

        await eventually_true(balanced)
        assert server.engine.memory.used(MemoryKind.STATE) == 0
