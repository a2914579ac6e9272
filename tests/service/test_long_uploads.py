"""Over HTTP the frames of a live stream come in one long request, where no proxy prevents it."""

import asyncio
from collections.abc import AsyncIterator

import httpx
import pytest

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import PROTOBUF, http_to
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.proxy import proxy_to
from tests.support.server import PATIENCE_S, running_server
from tests.support.session_frames import step
from vergence import DepthClient, Origin, SessionState
from vergence_proto.http_records import (
    ACCEPT_POST_HEADER,
    CALL_ID_HEADER,
    RECORDS_TYPE,
    RecordKind,
    RecordReader,
    pack_record,
)
from vergence_proto.v1 import depth_pb2 as pb

FRAME = pack_record(RecordKind.MESSAGE, frame_message(make_frame(1)).SerializeToString())


async def answers_to(client: httpx.AsyncClient, *body: bytes) -> tuple[list[str], str, int]:
    """Send a long body to a call: kinds of its answers, the reason of its end, the status."""
    opening = open_message().SerializeToString()
    kinds, reason, reader = [], "", RecordReader()
    async with client.stream("POST", "/v1/streams", content=opening, headers=PROTOBUF) as call:
        assert RECORDS_TYPE in call.headers[ACCEPT_POST_HEADER]

        async def chunks() -> AsyncIterator[bytes]:
            for chunk in body:
                yield chunk

        upload = asyncio.create_task(
            client.post(
                f"/v1/streams/{call.headers[CALL_ID_HEADER]}",
                content=chunks(),
                headers={"Content-Type": RECORDS_TYPE},
            )
        )
        async for piece in call.aiter_raw():
            for kind, content in reader.feed(piece):
                if kind is RecordKind.END:
                    reason = pb.FrameError.FromString(content).reason
                else:
                    message = pb.StreamDepthResponse.FromString(content)
                    kinds.append(str(message.WhichOneof("message")))
            if reason or len(kinds) > 1:
                break
        return kinds, reason, (await upload).status_code


@pytest.mark.parametrize(
    ("body", "reason", "status"),
    [
        ([FRAME[:3], FRAME[3:40], FRAME[40:]], "", 204),
        ([FRAME[:40]], "BAD_SHAPE", 400),
        ([pack_record(RecordKind.END, b"")], "BAD_SHAPE", 400),
        ([pack_record(RecordKind.MESSAGE, b"\xff")], "BAD_SHAPE", 400),
        ([b"\0\x7f\xff\xff\xff"], "FRAME_TOO_LARGE", 413),
    ],
    ids=["in pieces", "cut", "another kind", "no message", "too large"],
)
async def test_a_long_body_is_whole_messages(body: list[bytes], reason: str, status: int) -> None:
    async with running_server(RecallModel()) as server, http_to(server) as client:
        kinds, ended_by, answered = await asyncio.wait_for(answers_to(client, *body), PATIENCE_S)
    assert kinds == (["opened"] if reason else ["opened", "disparity"])
    assert (ended_by, answered) == (reason, status)


async def test_a_long_body_ends_with_its_call() -> None:
    async with running_server(RecallModel()) as server:
        async with (
            DepthClient(f"http://{server.http_address}") as client,
            client.open_session(RIG) as session,
        ):
            for index in range(3):
                await step(session, index)
            assert "vergence upload" in {task.get_name() for task in asyncio.all_tasks()}
        assert "vergence upload" not in {task.get_name() for task in asyncio.all_tasks()}
        await eventually(lambda: not len(server.engine.streams))


@pytest.mark.slow  # a second of silence
async def test_a_proxy_that_waits_for_whole_requests_costs_one_connection() -> None:
    async with (
        running_server(RecallModel()) as server,
        proxy_to(server.http_address, whole_requests=True) as proxy,
        DepthClient(f"http://{proxy.address}") as client,
        client.open_session(RIG) as session,
    ):
        results = [await step(session, index) for index in range(3)]
        assert session.state is SessionState.LIVE
    assert [each.step_count for each in results] == [1, 2, 3]
    assert results[-1].origin is Origin.WARM
