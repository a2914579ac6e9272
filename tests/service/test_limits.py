"""A server has room for so many streams, of so many clients, with so much memory."""

import asyncio
from dataclasses import replace

import grpc
import httpx
import pytest
from google.rpc import error_details_pb2

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import PROTOBUF
from tests.support.models import RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of, unpack_detail
from vergence import DepthClient
from vergence_proto.errors import Quota
from vergence_proto.types import StereoRig
from vergence_service.process.memory import MemoryKind
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.search_window import SearchReach


def seconds_to_wait(refusal: grpc.aio.AioRpcError) -> int:
    """What the server's RetryInfo asks for, whole seconds."""
    retry = error_details_pb2.RetryInfo()
    unpack_detail(refusal, retry)
    return int(retry.retry_delay.seconds)


async def test_a_full_server_says_when_to_come_back() -> None:
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        raw_stream(server),
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message())
    assert reason_of(failure.value) == "STREAM_LIMIT"
    assert 0 < seconds_to_wait(failure.value) <= 60


async def test_a_client_that_has_its_share_is_refused_and_leaves_room_to_others() -> None:
    async with (
        running_server(RecallModel(), limits__streams_per_client=1) as server,
        raw_stream(server, "mine") as mine,
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message())
        assert reason_of(failure.value) == "QUOTA"
        assert 0 < seconds_to_wait(failure.value) <= 60
        # A share is an address's, by whatever door; to come back to what one has takes no other.
        async with DepthClient(f"http://{server.http_address}") as same:
            with pytest.raises(Quota, match=r"127\.0\.0\.1 has 1 open streams"):
                async with same.open_session(RIG, open_timeout_s=0.1):
                    pass
        token = mine.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as again:
            assert (await again.ask(frame_message(make_frame(1)))).HasField("disparity")
        elsewhere = httpx.AsyncHTTPTransport(local_address="127.0.0.2")
        async with httpx.AsyncClient(transport=elsewhere) as other:
            url = f"http://{server.http_address}/v1/streams"
            body = open_message("theirs").SerializeToString()
            async with other.stream("POST", url, content=body, headers=PROTOBUF) as answer:
                assert answer.status_code == 200
                assert server.engine.streams.get("theirs").client == "127.0.0.2"


async def test_streams_take_no_more_memory_than_allowed() -> None:
    large = StereoRig.from_rectified(replace(RIG, width=512, height=400))  # needs 7 MiB
    async with (
        running_server(RecallModel(), limits__max_state_mib=9) as server,
        raw_stream(server, rig=large),
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message(rig=large))
    assert reason_of(failure.value) == "STATE_MEMORY"
    assert 0 < seconds_to_wait(failure.value) <= 60


@pytest.mark.parametrize(
    ("width", "height", "reason"),
    [
        (4097, 16, "FRAME_TOO_LARGE"),
        (16, 4097, "FRAME_TOO_LARGE"),
        (2048, 2048, "FRAME_TOO_LARGE"),
        (15, 64, "BAD_CALIBRATION"),
        (64, 15, "BAD_CALIBRATION"),
    ],
)
async def test_images_that_are_too_large_too_long_or_too_thin_are_refused(
    width: int, height: int, reason: str
) -> None:
    rig = StereoRig.from_rectified(replace(RIG, width=width, height=height))
    async with running_server(RecallModel()) as server, connected(server) as stub:
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message(rig=rig))
        assert reason_of(failure.value) == reason
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message(rig=rig, every=False))
        assert reason_of(failure.value) == reason


async def test_a_refused_opening_makes_no_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is made for a stream, as the maps of its cameras, is made after a look at the limits."""
    made: list[StereoRig] = []
    of = Rectifier.of

    def counted(rig: StereoRig, reach: SearchReach) -> Rectifier:
        made.append(rig)
        return of(rig, reach)

    monkeypatch.setattr(Rectifier, "of", counted)
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        raw_stream(server),
        connected(server) as stub,
    ):
        for _ in range(3):
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await RawCall(stub.StreamDepth()).ask(open_message())
            assert reason_of(failure.value) == "STREAM_LIMIT"
    assert len(made) == 1


async def test_waiting_frames_are_counted_and_a_live_one_without_memory_is_refused() -> None:
    need = 64 * RIG.width * RIG.height  # of a step of the model; the rest is a third of it
    frame = frame_message(make_frame(1)).ByteSize()
    model = RecallModel()
    async with (
        running_server(model, limits__max_state_mib=1) as server,
        raw_stream(server, every=False) as live,
    ):
        memory = server.engine.memory
        free = (1 << 20) - sum(memory.used(kind) for kind in MemoryKind)
        assert need < (1 << 20) - free < 2 * need
        with memory.hold_frame(free - frame // 2):
            error = (await live.ask(frame_message(make_frame(1)))).frame_error
            assert (error.frame_id, error.reason) == (1, "STATE_MEMORY")
        with model.busy():
            await live.send(frame_message(make_frame(2)))
            await asyncio.to_thread(model.wait_until_entered)
            assert memory.used(MemoryKind.FRAMES) > frame // 2
        answer = await live.receive()
        assert answer is not None
        assert answer.disparity.frame_id == 2
    assert memory.used(MemoryKind.FRAMES) == 0
