"""A server has room for so many streams, of so many clients, with so much state."""

from dataclasses import replace

import grpc
import httpx
import pytest
from google.rpc import error_details_pb2

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of, unpack_detail
from vergence import DepthClient
from vergence_proto.errors import Quota
from vergence_proto.types import StereoRig


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


async def test_a_client_that_has_its_share_is_told_so_and_leaves_room_to_others() -> None:
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
                async with same.open_session(RIG):
                    pass
        token = mine.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as again:
            assert (await again.ask(frame_message(make_frame(1)))).HasField("disparity")
        elsewhere = httpx.AsyncHTTPTransport(local_address="127.0.0.2")
        async with httpx.AsyncClient(transport=elsewhere) as other:
            url = f"http://{server.http_address}/v1/streams"
            body = open_message("theirs").SerializeToString()
            async with other.stream("POST", url, content=body) as answer:
                assert answer.status_code == 200
                assert server.engine.streams.get("theirs").client == "127.0.0.2"


async def test_states_take_no_more_memory_than_allowed() -> None:
    large = StereoRig.from_rectified(replace(RIG, width=512, height=400))  # 0.8 MB of state
    async with (
        running_server(RecallModel(), limits__max_state_mib=1) as server,
        raw_stream(server, rig=large),
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message(rig=large))
    assert reason_of(failure.value) == "STATE_MEMORY"
