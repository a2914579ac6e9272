"""A client that is silent or slow costs little: each of its waits has a limit."""

import asyncio
import logging
import os
import resource
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.http import PROTOBUF, http_to
from tests.support.http import reason_of as reason_over_http
from tests.support.models import RecallModel
from tests.support.polling import eventually, eventually_true
from tests.support.proxy import proxy_to
from tests.support.server import (
    PATIENCE_S,
    ManualClock,
    RawCall,
    connected,
    raw_stream,
    running_server,
)
from tests.support.status import reason_of
from vergence_proto.geometry import RectifiedRig
from vergence_proto.http_records import CALL_ID_HEADER, PROTOBUF_TYPE
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.app.server import Running

# A map of this size is larger than all that a client's connection takes unread.
LARGE = RectifiedRig(160, 128, 150.0, 150.0, 79.5, 79.5, 63.5, 0.1)
_NO_HEADERS = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
SMALL_WINDOW = (("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 65_535))


@asynccontextmanager
async def own_connection(server: Running) -> AsyncIterator[depth_pb2_grpc.DepthServiceStub]:
    """A connection that is not shared, whose client takes little that it does not read."""
    options = (*SMALL_WINDOW, ("grpc.use_local_subchannel_pool", 1))
    async with grpc.aio.insecure_channel(server.grpc_address, options=options) as channel:
        yield depth_pb2_grpc.DepthServiceStub(channel)


async def opened_large(stub: depth_pb2_grpc.DepthServiceStub, stream_id: str) -> RawCall:
    raw = RawCall(stub.StreamDepth())
    await raw.ask(open_message(stream_id, rig=StereoRig.from_rectified(LARGE)))
    return raw


async def status_behind_answers(call: RawCall) -> grpc.StatusCode:
    """The status of a call that ends, behind the answers that arrived before it."""
    try:
        while await call.receive() is not None:
            pass
    except grpc.aio.AioRpcError as failure:
        return failure.code()
    return grpc.StatusCode.OK


async def closed(reader: asyncio.StreamReader) -> bytes:
    """All that the server sends until it closes the connection."""
    async with asyncio.timeout(PATIENCE_S):
        return await reader.read()


@pytest.mark.parametrize("method", ["StreamDepth", "GetServerInfo"])
async def test_a_grpc_call_without_a_first_message_is_ended(method: str) -> None:
    async with (
        running_server(RecallModel(), limits__first_message_s=0.1) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
    ):
        start: Any = channel.stream_stream  # its stubs demand what it does not
        call = start(f"/vergence.v1.DepthService/{method}")()
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await asyncio.wait_for(call.read(), PATIENCE_S)
    assert failure.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert reason_of(failure.value) == "CLIENT_TIMEOUT"


async def test_a_client_that_leaves_without_a_word_is_no_failure(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with running_server(RecallModel()) as server, own_connection(server) as stub:
        for _ in range(20):
            call: Any = stub.StreamDepth()
            await call.wait_for_connection()
            await call.done_writing()
            call.cancel()
        await stub.GetServerInfo(pb.GetServerInfoRequest())
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


async def test_every_service_answers_behind_the_deadline() -> None:
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
        connected(server) as stub,
    ):
        health = health_pb2_grpc.HealthStub(channel)
        answer = await health.Check(health_pb2.HealthCheckRequest())
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
        assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_max == 64
        invoke: Any = channel.unary_unary
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await invoke("/vergence.v1.DepthService/Nothing")(b"")
    assert failure.value.code() is grpc.StatusCode.UNIMPLEMENTED


async def test_a_client_that_does_not_read_is_disconnected() -> None:
    async with (
        running_server(RecallModel(), limits__write_s=0.1) as server,
        own_connection(server) as stub,
    ):
        slow = await opened_large(stub, "slow")
        descriptors = len(os.listdir("/dev/fd"))
        for frame_id in (1, 2):
            await slow.send(frame_message(make_frame(frame_id, rig=LARGE)))
        await eventually(slow.call.done)
        # Both ends of the connection are in this process.
        await eventually(lambda: len(os.listdir("/dev/fd")) <= descriptors - 2)
        assert await slow.call.code() is grpc.StatusCode.UNAVAILABLE
        assert server.engine.streams.get("slow").attachment is None
        # It may come back and resume, as after any lost connection.
        async with raw_stream(server, "other") as other:
            await other.ask(frame_message(make_frame(1)))


async def test_an_expired_client_that_sent_beyond_its_credit_is_disconnected() -> None:
    clock, model = ManualClock(), RecallModel()
    async with running_server(model, clock=clock) as server, own_connection(server) as stub:
        call = RawCall(stub.StreamDepth())
        await call.ask(open_message("mine"))
        for frame_id in range(1, 6):  # nobody reads the answers
            await call.send(frame_message(make_frame(frame_id)))
        await eventually(lambda: server.engine.streams.get("mine").frames_stepped == 5)
        clock.advance(60)
        server.engine.streams.sweep()
        await eventually(call.call.done)
        assert await call.call.code() is grpc.StatusCode.UNAVAILABLE


async def test_other_calls_of_a_connection_survive_the_one_that_does_not_read() -> None:
    async with (
        running_server(RecallModel(), limits__write_s=0.1) as server,
        own_connection(server) as stub,
    ):
        slow = await opened_large(stub, "slow")
        healthy = RawCall(stub.StreamDepth())
        await healthy.ask(open_message("healthy"))
        for frame_id in (1, 2):
            await slow.send(frame_message(make_frame(frame_id, rig=LARGE)))
        await eventually(lambda: server.engine.streams.get("slow").attachment is None)
        for frame_id in (1, 2, 3):
            answer = await healthy.ask(frame_message(make_frame(frame_id)))
            assert answer.disparity.step_count == frame_id
        assert await status_behind_answers(slow) is grpc.StatusCode.UNAVAILABLE


async def test_a_silent_client_counts_as_lost_and_may_resume() -> None:
    clock = ManualClock()
    async with running_server(RecallModel(), clock=clock) as server:
        async with raw_stream(server, "mine") as call:
            await call.ask(frame_message(make_frame(1)))
            clock.advance(14.9)
            await call.ask(pb.StreamDepthRequest(ping=pb.Ping()))
            clock.advance(14.9)
            server.engine.streams.sweep()
            await call.ask(pb.StreamDepthRequest(ping=pb.Ping()))  # still attached
            clock.advance(15)
            server.engine.streams.sweep()
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await call.receive()
            assert failure.value.code() is grpc.StatusCode.UNAVAILABLE
            assert "sent nothing for 15 s" in str(failure.value.details())
        token = call.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as call:
            assert call.opened.silent_s == 15
            answer = await call.ask(frame_message(make_frame(2)))
    assert answer.disparity.step_count == 2


async def test_a_client_that_waits_for_its_answer_is_neither_silent_nor_idle() -> None:
    clock, model = ManualClock(), RecallModel()
    async with running_server(model, clock=clock) as server, raw_stream(server, "mine") as call:
        with model.busy():
            for frame_id in (1, 2):  # one is stepped, one waits
                await call.send(frame_message(make_frame(frame_id)))
            await asyncio.to_thread(model.wait_until_entered)
            clock.advance(1000)
            server.engine.streams.sweep()
            assert server.engine.streams.idle_s(server.engine.streams.get("mine")) == 0
        answers = [await call.receive() for _ in range(2)]
        clock.advance(14)  # the time of silence and of idleness starts at the answer
        server.engine.streams.sweep()
        await call.ask(frame_message(make_frame(3)))
    assert [answer and answer.disparity.frame_id for answer in answers] == [1, 2]


async def test_a_client_that_never_pings_is_not_expected_to() -> None:
    clock = ManualClock()
    async with running_server(RecallModel(), clock=clock) as server, raw_stream(server) as call:
        clock.advance(40)
        server.engine.streams.sweep()
        await call.ask(frame_message(make_frame(1)))


async def test_a_silent_client_over_http_counts_as_lost() -> None:
    clock = ManualClock()
    async with (
        running_server(RecallModel(), clock=clock) as server,
        http_to(server) as http,
        http.stream(
            "POST",
            "/v1/streams",
            content=open_message("mine").SerializeToString(),
            headers=PROTOBUF,
        ) as answer,
    ):
        records = answer.aiter_raw()
        await anext(records)
        ping = pb.StreamDepthRequest(ping=pb.Ping()).SerializeToString()
        await http.post(
            f"/v1/streams/{answer.headers[CALL_ID_HEADER]}", content=ping, headers=PROTOBUF
        )
        await anext(records)
        clock.advance(15)
        server.engine.streams.sweep()
        assert [record async for record in records] == []  # broken off: no end record
        assert server.engine.streams.get("mine").attachment is None


async def test_a_client_over_http_that_does_not_read_is_disconnected() -> None:
    async with (
        running_server(RecallModel(), limits__write_s=0.2) as server,
        http_to(server) as http,
    ):
        host, _, port = server.http_address.rpartition(":")
        narrow = socket.create_connection((host, int(port)))
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        reader, writer = await asyncio.open_connection(sock=narrow)
        body = open_message("slow", rig=StereoRig.from_rectified(LARGE)).SerializeToString()
        head = (
            "POST /v1/streams HTTP/1.1\r\nhost: [::1]\r\n"
            f"content-type: {PROTOBUF_TYPE}\r\ncontent-length: {len(body)}\r\n\r\n"
        )
        writer.write(head.encode() + body)
        response = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE_S)
        [call_id] = [
            line.split(b": ")[1].decode()
            for line in response.split(b"\r\n")
            if line.lower().startswith(CALL_ID_HEADER.lower().encode())
        ]
        frame_id, sent = 0, int(httpx.codes.NO_CONTENT)
        while sent == httpx.codes.NO_CONTENT:
            frame_id += 1
            frame = frame_message(make_frame(frame_id, rig=LARGE)).SerializeToString()
            answer = await http.post(f"/v1/streams/{call_id}", content=frame, headers=PROTOBUF)
            sent = answer.status_code
        assert sent == httpx.codes.NOT_FOUND
        await eventually(lambda: server.engine.streams.get("slow").attachment is None)
        writer.close()


@pytest.mark.parametrize(
    ("requests_before", "sent"),
    [(0, b""), (0, b"GET /healthz HTTP/1.1\r\nHost: [::1]\r\nX"), (1, b"GET /heal")],
    ids=["nothing", "half-headers", "half-headers-of-the-second-request"],
)
async def test_a_request_without_its_headers_is_ended(requests_before: int, sent: bytes) -> None:
    async with running_server(RecallModel(), limits__first_message_s=0.1) as server:
        reader, writer = await asyncio.open_connection(*server.http_address.split(":"))
        for _ in range(requests_before):
            writer.write(b"GET /healthz HTTP/1.1\r\nHost: [::1]\r\n\r\n")
            await asyncio.wait_for(reader.readuntil(b'{"status":"alive"}'), PATIENCE_S)
        writer.write(sent)
        answer = await closed(reader)
        writer.close()
    assert answer == _NO_HEADERS


@pytest.mark.parametrize("path", ["/v1/methods/GetServerInfo", "/v1/streams", "/v1/sequences"])
async def test_a_body_that_comes_too_slowly_is_refused(path: str) -> None:
    quick: dict[str, Any] = {"limits__first_message_s": 0.1, "batch__idle_s": 0.1}
    kind = "application/zip" if path == "/v1/sequences" else PROTOBUF_TYPE
    async with running_server(RecallModel(), **quick) as server:
        reader, writer = await asyncio.open_connection(*server.http_address.split(":"))
        writer.write(
            f"POST {path} HTTP/1.1\r\nHost: [::1]\r\nContent-Length: 100000\r\n"
            f"Content-Type: {kind}\r\n\r\n".encode()
        )
        reading = asyncio.create_task(reader.readuntil(b"\r\n\r\n"))
        while not reading.done():
            writer.write(b"x")
            await asyncio.wait([reading], timeout=0.01)
        writer.close()
    assert reading.result().startswith(b"HTTP/1.1 408 ")
    assert b"connection: close" in reading.result().lower()


async def test_a_body_in_many_pieces_is_read_if_it_is_fast_enough() -> None:
    message = pb.GetServerInfoRequest().SerializeToString()

    async def pieces() -> AsyncIterator[bytes]:
        for _ in range(20):  # longer than the patience, all together
            await asyncio.sleep(0.02)
            yield b"\x0a\x00" * 50  # a field that this version does not know
        yield message

    quick: dict[str, Any] = {"limits__first_message_s": 0.2, "limits__min_kib_per_s": 1.0}
    async with running_server(RecallModel(), **quick) as server, http_to(server) as http:
        answer = await http.post(
            "/v1/methods/GetServerInfo",
            content=pieces(),
            headers={"Content-Type": PROTOBUF_TYPE},
        )
    assert answer.status_code == httpx.codes.OK, reason_over_http(answer)


async def test_connections_beyond_the_limit_are_refused_and_the_others_served() -> None:
    async with running_server(RecallModel(), limits__connections=2) as server:
        async with own_connection(server) as first, own_connection(server) as second:
            mine = RawCall(first.StreamDepth())
            await mine.ask(open_message("mine"))
            await second.GetServerInfo(pb.GetServerInfoRequest())
            async with own_connection(server) as third:
                with pytest.raises(grpc.aio.AioRpcError) as failure:
                    await third.GetServerInfo(pb.GetServerInfoRequest())
            assert failure.value.code() is grpc.StatusCode.UNAVAILABLE
            assert (await mine.ask(frame_message(make_frame(1)))).HasField("disparity")
        address = server.http_address.split(":")
        held = [await asyncio.open_connection(*address) for _ in range(2)]
        reader, writer = await asyncio.open_connection(*address)
        refusal = await closed(reader)
        assert refusal.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after" in refusal
        for _, each in (*held, (reader, writer)):
            each.close()
        async with http_to(server) as http:

            async def served() -> bool:
                return (await http.get("/healthz")).status_code == httpx.codes.OK

            await eventually_true(served)


async def test_close_stream_returns_when_the_streams_own_connection_has_ended() -> None:
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        raw_stream(server, "mine") as call,
        connected(server) as stub,
    ):
        token = call.opened.resume_token
        await stub.CloseStream(pb.CloseStreamRequest(stream_id="mine", resume_token=token))
        async with raw_stream(server, "next"):  # its place is free at once
            pass


def test_descriptors_are_raised_and_connections_are_fewer_if_they_are_scarce() -> None:
    code = (
        "import resource\n"
        "from vergence_service.process.descriptors import affordable_connections\n"
        "from vergence_service.process.descriptors import raise_descriptor_limit\n"
        "raise_descriptor_limit()\n"
        "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])\n"
        "print(affordable_connections(1000), affordable_connections(8))\n"
    )

    def scarce() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (48, 92))

    printed = subprocess.run(
        [sys.executable, "-c", code], preexec_fn=scarce, capture_output=True, text=True, check=True
    ).stdout
    assert printed.split() == ["92", "20", "8"]


async def test_a_client_that_dies_while_it_is_sent_an_answer_is_no_failure_of_the_server(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    async with (
        running_server(RecallModel()) as server,
        proxy_to(server.grpc_address) as proxy,
        grpc.aio.insecure_channel(proxy.address, options=SMALL_WINDOW) as channel,
    ):
        call = RawCall(depth_pb2_grpc.DepthServiceStub(channel).StreamDepth())
        opening = open_message(rig=StereoRig.from_rectified(LARGE))
        stream = server.engine.streams.get((await call.ask(opening)).opened.stream_id)
        for frame_id in range(1, 5):
            await call.send(frame_message(make_frame(frame_id, rig=LARGE)))
        await eventually(lambda: stream.frames_stepped >= 2)  # the answer before is being sent
        proxy.cut()
        await eventually(lambda: stream.attachment is None)
    assert not [record for record in caplog.records if record.exc_info]
    assert "disconnected while it was sent an answer" in caplog.text
