"""The real server on ephemeral ports, in this process or in one of its own."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory
from typing import Any

import grpc

from tests.support.frames import open_message
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.app.server import Running, running
from vergence_service.inference.model import StereoModel
from vergence_service.settings import load_settings

PATIENCE_S = 20.0  # a test that hangs fails instead


@dataclass
class ManualClock:
    """Seconds that pass when the test says so."""

    now_s: float = 1000.0

    def __call__(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> None:
        self.now_s += seconds


@asynccontextmanager
async def running_server(
    model: StereoModel, *, clock: ManualClock | None = None, **flags: Any
) -> AsyncIterator[Running]:
    """A server with ``model`` on free ports. Flags are settings with ``__`` for the dot."""
    with TemporaryDirectory() as jobs:
        settings = load_settings(
            flags={
                "grpc.port": 0,
                "http.port": 0,
                "admin.port": 0,
                "batch.directory": jobs,
                **{name.replace("__", "."): value for name, value in flags.items()},
            }
        )
        async with running(settings, model, **({"clock": clock} if clock else {})) as server:
            yield server


@dataclass(eq=False)
class RawCall:
    """A StreamDepth call, message by message."""

    call: Any  # grpc.aio's StreamStreamCall, which its stubs do not type by message
    opened: pb.StreamOpened = field(default_factory=pb.StreamOpened)

    async def send(self, message: pb.StreamDepthRequest) -> None:
        await asyncio.wait_for(self.call.write(message), PATIENCE_S)

    async def receive(self) -> pb.StreamDepthResponse | None:
        """The next answer; None at the end. Raises grpc.aio.AioRpcError if it ends with one."""
        answer = await asyncio.wait_for(self.call.read(), PATIENCE_S)
        return answer if isinstance(answer, pb.StreamDepthResponse) else None

    async def ask(self, message: pb.StreamDepthRequest) -> pb.StreamDepthResponse:
        await self.send(message)
        answer = await self.receive()
        assert answer is not None, "the call ended instead of an answer"
        return answer


@asynccontextmanager
async def connected(server: Running) -> AsyncIterator[depth_pb2_grpc.DepthServiceStub]:
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        yield depth_pb2_grpc.DepthServiceStub(channel)  # generated


@asynccontextmanager
async def raw_stream(
    server: Running, stream_id: str = "", **opening: Any
) -> AsyncIterator[RawCall]:
    """An open stream on a connection of its own, which is cut when the block ends."""
    async with connected(server) as stub:
        raw = RawCall(stub.StreamDepth())
        answer = await raw.ask(open_message(stream_id, **opening))
        raw.opened = answer.opened
        try:
            yield raw
        finally:
            raw.call.cancel()
