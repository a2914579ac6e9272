"""A hostile message ends its own call in words, costs little memory, and touches nobody else."""

from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2

from tests.support.frames import frame_message, make_frame
from tests.support.http import PROTOBUF
from tests.support.models import RecallModel
from tests.support.server import raw_stream, running_server

BOMB = b"\x0a\x00\x12\x00" * (1 << 18)
UNKNOWN_FIELDS = b"\xf2\x06\x00" * (1 << 18)
DEPTH = "/vergence.v1.DepthService/"
HEALTH = "/grpc.health.v1.Health/"
REFLECTION = "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo"
INVALID, TOO_LARGE = grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.RESOURCE_EXHAUSTED


async def asked(channel: grpc.aio.Channel, kind: str, path: str, message: bytes) -> Any:
    connect: Any = getattr(channel, kind)  # without serialisers it speaks bytes
    if kind == "unary_unary":
        return await connect(path)(message)
    if kind == "unary_stream":
        return await connect(path)(message).read()
    call = connect(path)()
    await call.write(message)
    return await call.read()


@pytest.mark.parametrize(
    ("kind", "path", "message", "status"),
    [
        ("stream_stream", f"{DEPTH}StreamDepth", BOMB, INVALID),
        ("stream_stream", f"{DEPTH}StreamDepth", b"\xff" * 50, INVALID),
        ("stream_stream", f"{DEPTH}StreamDepth", UNKNOWN_FIELDS, TOO_LARGE),
        ("unary_unary", f"{DEPTH}GetServerInfo", UNKNOWN_FIELDS, TOO_LARGE),
        ("unary_unary", f"{DEPTH}GetStream", b"\xff" * 50, INVALID),
        ("unary_unary", f"{HEALTH}Check", UNKNOWN_FIELDS, TOO_LARGE),
        ("unary_unary", f"{HEALTH}Check", b"\xff" * 50, INVALID),
        ("unary_stream", f"{HEALTH}Watch", UNKNOWN_FIELDS, TOO_LARGE),
        ("stream_stream", REFLECTION, UNKNOWN_FIELDS, TOO_LARGE),
    ],
)
async def test_over_grpc_a_bomb_ends_its_call_in_words(
    kind: str,
    path: str,
    message: bytes,
    status: grpc.StatusCode,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server) as neighbour,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await asked(channel, kind, path, message)
        assert refusal.value.code() is status
        assert "expected" in (refusal.value.details() or "")
        answer = await neighbour.ask(frame_message(make_frame(1)))
        assert answer.HasField("disparity")
        ask: Any = channel.unary_unary
        health = health_pb2.HealthCheckResponse.FromString(await ask(f"{HEALTH}Check")(b""))
        assert health.status == health_pb2.HealthCheckResponse.SERVING
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/v1/streams", BOMB[: 1 << 15], 400),
        ("/v1/streams", BOMB, 413),
        ("/v1/methods/GetServerInfo", UNKNOWN_FIELDS, 413),
        ("/v1/methods/GetStream", b"\xff" * 50, 400),
    ],
)
async def test_over_http_a_bomb_is_refused(path: str, body: bytes, status: int) -> None:
    async with running_server(RecallModel()) as server, httpx.AsyncClient() as client:
        answer = await client.post(
            f"http://{server.http_address}{path}", content=body, headers=PROTOBUF
        )
        assert answer.status_code == status
        assert "expected" in answer.json()["detail"]


@pytest.mark.parametrize("algorithm", [grpc.Compression.Gzip, grpc.Compression.Deflate])
async def test_grpcs_own_compression_is_refused(algorithm: grpc.Compression) -> None:
    # Else 30 kB become a message of 32 MiB before the server has seen a byte of it.
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address, compression=algorithm) as channel,
        raw_stream(server) as neighbour,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await asked(channel, "unary_unary", f"{DEPTH}GetServerInfo", bytes(1 << 10))
        assert refusal.value.code() is grpc.StatusCode.UNIMPLEMENTED
        assert "compression" in (refusal.value.details() or "").lower()
        answer = await neighbour.ask(frame_message(make_frame(1)))
        assert answer.HasField("disparity")
