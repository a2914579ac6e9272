"""Calls that break the protocol end with a reason, and harm neither streams nor the server."""

import asyncio
from dataclasses import replace
from typing import Any

import grpc
import pytest

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.app.server import Running


async def ends_with(call: RawCall, message: pb.StreamDepthRequest) -> str:
    with pytest.raises(grpc.aio.AioRpcError) as failure:
        await call.ask(message)
    return reason_of(failure.value)


async def test_a_call_must_begin_by_opening() -> None:
    async with running_server(RecallModel()) as server, connected(server) as stub:
        call = RawCall(stub.StreamDepth())
        assert await ends_with(call, frame_message(make_frame(1))) == "STREAM_UNKNOWN"


async def test_a_call_opens_one_stream() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        assert await ends_with(call, open_message("second")) == "STREAM_EXISTS"


async def test_a_message_without_content_ends_the_call() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        assert await ends_with(call, pb.StreamDepthRequest()) == "BAD_SHAPE"


@pytest.mark.parametrize("opened", [False, True], ids=["at-first", "later"])
async def test_bytes_that_are_no_message_end_the_call_and_keep_the_stream(opened: bool) -> None:
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
        connected(server) as stub,
    ):
        # Typed stubs cannot send what is no message, so this channel speaks bytes.
        speak: Any = channel.stream_stream
        call = speak("/vergence.v1.DepthService/StreamDepth")()
        if opened:
            await call.write(open_message("mine").SerializeToString())
            await call.read()
        await call.write(b"\xff\xff\xff nonsense")
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await asyncio.wait_for(call.read(), 10)
        assert failure.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert reason_of(failure.value) == "BAD_SHAPE"
        info = await stub.GetServerInfo(pb.GetServerInfoRequest())
        assert info.streams_open == int(opened)


async def test_a_message_far_over_the_limit_ends_the_call_and_keeps_the_stream() -> None:
    async with (
        running_server(RecallModel(), limits__max_frame_mib=1) as server,
        raw_stream(server, "mine") as call,
        connected(server) as stub,
    ):
        await call.ask(frame_message(make_frame(1)))
        huge = frame_message(make_frame(2))
        huge.frame.left.data = bytes(4 << 20)
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.ask(huge)
        assert failure.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        token = call.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as again:
            assert (again.opened.resumed, again.opened.last_frame_id) == (True, 1)
        assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_open == 1


@pytest.mark.parametrize("method", ["GetStream", "ResetStream", "CloseStream"])
async def test_an_unknown_stream_is_reported_as_such(method: str) -> None:
    async with running_server(RecallModel()) as server, connected(server) as stub:
        request = getattr(pb, f"{method}Request")(stream_id="nowhere")
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await getattr(stub, method)(request)
        assert failure.value.code() is grpc.StatusCode.NOT_FOUND
        assert reason_of(failure.value) == "STREAM_UNKNOWN"


async def still_serves(server: Running) -> bool:
    async with raw_stream(server) as call:
        return (await call.ask(frame_message(make_frame(1)))).HasField("disparity")


async def test_http_on_the_grpc_port_is_cut_and_harms_nobody() -> None:
    async with running_server(RecallModel()) as server:
        host, port = server.grpc_address.rsplit(":", 1)
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        rest = await asyncio.wait_for(reader.read(), 10)
        writer.close()
        assert not rest.startswith(b"HTTP/1.1 200")
        assert await still_serves(server)


async def test_grpc_on_the_http_port_fails_at_once_and_harms_nobody() -> None:
    async with running_server(RecallModel()) as server:
        async with connected(replace(server, grpc_address=server.http_address)) as stub:
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await stub.GetServerInfo(pb.GetServerInfoRequest(), timeout=10)
        assert failure.value.code() is grpc.StatusCode.UNAVAILABLE
        assert await still_serves(server)
