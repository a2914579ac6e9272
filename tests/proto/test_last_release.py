"""SDK and server of the last release work with those of today, by the bytes of a recorded session.

:mod:`tests.support.wire_recorder` says how the session was recorded. Its messages are read with the
schema of that release, in which every newer field is unknown.
"""

import asyncio
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from tests.support.models import RecallModel
from tests.support.server import PATIENCE_S, running_server
from tests.support.wire_recorder import read_recorded, released_pairs, released_rig
from vergence import DepthClient, DepthResult, Origin, OutputFormat, Pose

ROOT = Path(__file__).parents[2]
SERVICE = "/vergence.v1.DepthService/"
RECORDED = read_recorded(ROOT / "tests/support/released_session.bin")


def released_types() -> Any:
    pool = descriptor_pool.DescriptorPool()
    files = descriptor_pb2.FileDescriptorSet.FromString(
        (ROOT / "proto/released.binpb").read_bytes()
    )
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClassesForFiles([file.name for file in files.file], pool)


TYPES = released_types()
Request = TYPES["vergence.v1.StreamDepthRequest"]
Response = TYPES["vergence.v1.StreamDepthResponse"]


def recorded(name: str) -> list[bytes]:
    return [message for each, message in RECORDED if each == SERVICE + name]


def by_kind(answers: Iterable[bytes]) -> dict[str, list[Any]]:
    """Read answers as the last release does, without what it does not know and what varies."""
    kinds: dict[str, list[Any]] = {}
    for answer in answers:
        message = Response.FromString(answer)
        message.DiscardUnknownFields()
        kind = message.WhichOneof("message")
        if kind == "disparity":
            message.disparity.ClearField("timings")
        kinds.setdefault(kind, []).append(message)
    return kinds


async def test_the_last_sdk_gets_what_it_got_from_its_own_server() -> None:
    requests, expected = recorded("StreamDepth>"), recorded("StreamDepth<")
    answers: list[bytes] = []
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
        asyncio.timeout(PATIENCE_S),
    ):
        start: Any = channel.stream_stream
        call = start(f"{SERVICE}StreamDepth")(metadata=[("x-stream-id", "recorded")])
        answered = [b"open"]
        for request in requests:
            kind = Request.FromString(request).WhichOneof("message")
            await call.write(request)
            if kind in ("open", "frame"):  # a client of one frame at a time
                while len(answers) < len(answered):
                    answers.append(await call.read())
                answered.append(request)
        while len(answers) < len(expected):
            answers.append(await call.read())
        assert not await call.read()  # the end
    now, then = by_kind(answers), by_kind(expected)
    assert now["disparity"] == then["disparity"]
    assert len(now["pong"]) == len(then["pong"])
    [opened], [opened_then] = now["opened"], then["opened"]
    assert opened.opened.rig == opened_then.opened.rig
    assert opened.opened.model == opened_then.opened.model


class LastServer(grpc.GenericRpcHandler):  # type: ignore[type-arg]  # not generic at run time
    """The last release's server, by its recorded answers and its schema."""

    def __init__(self) -> None:
        self._maps = by_kind(recorded("StreamDepth<"))["disparity"]
        self._opened = recorded("StreamDepth<")[0]

    def service(self, handler_call_details: Any) -> Any:
        if handler_call_details.method == f"{SERVICE}GetServerInfo":
            return grpc.unary_unary_rpc_method_handler(self._info)
        return grpc.stream_stream_rpc_method_handler(self._stream)

    async def _info(self, request: bytes, context: object) -> bytes:
        return recorded("GetServerInfo<")[0]

    async def _stream(
        self, requests: AsyncIterator[bytes], context: object
    ) -> AsyncIterator[bytes]:
        frames = 0
        async for each in requests:
            request = Request.FromString(each)
            match request.WhichOneof("message"):
                case "open":
                    yield self._opened
                case "ping":
                    pong = TYPES["vergence.v1.Pong"](client_ns=request.ping.client_ns)
                    yield Response(pong=pong).SerializeToString()
                case "frame":
                    answer = Response()
                    answer.CopyFrom(self._maps[frames % len(self._maps)])
                    answer.disparity.frame_id = request.frame.frame_id
                    answer.disparity.capture_ns = request.frame.capture_ns
                    frames += 1
                    yield answer.SerializeToString()
                case "end":
                    return


async def test_the_sdk_works_with_the_last_server() -> None:
    server = grpc.aio.server()
    server.add_generic_rpc_handlers((LastServer(),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        async with DepthClient(f"grpc://127.0.0.1:{port}") as client, asyncio.timeout(PATIENCE_S):
            assert (await client.server_info()).version == "0.1.0"
            exact = await results_of(client, link="fixed")
            # It asks for maps of every second pixel, and gets whole ones.
            small = await results_of(client, link="auto", output=OutputFormat(map_step=2))
    finally:
        await server.stop(None)
    assert [each.origin for each in exact] == [Origin.COLD_START, Origin.WARM, Origin.WARM]
    assert [each.step_count for each in exact] == [1, 2, 3]
    for one, other in zip(exact, small, strict=True):
        assert one.disparity_px.shape == (released_rig.height, released_rig.width)
        np.testing.assert_array_equal(one.disparity_px, other.disparity_px)


async def results_of(client: DepthClient, **options: Any) -> list[DepthResult]:
    async with client.open_session(released_rig, **options) as session:
        return [
            await session.step(left, right, Pose.identity(), capture_ns=(index + 1) * 33_000_000)
            for index, (left, right) in enumerate(released_pairs())
        ]
