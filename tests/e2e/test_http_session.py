"""A session over http:// has the same answers and errors, and recovers in the same way."""

import asyncio

import numpy as np
import pytest

from tests.support.frames import RIG
from tests.support.http import disparities, ended, http_to, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.proxy import proxy_to
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import running_server
from vergence import (
    BadCalibration,
    ConnectionLost,
    Delivery,
    DepthClient,
    DepthSession,
    Draining,
    EventKind,
    NonFinite,
    NotReady,
    Origin,
    OutputFormat,
    PlaneEncoding,
    SessionEvent,
    StreamExists,
    Superseded,
    UnknownStream,
)
from vergence_proto.types import DisparityMap, StereoFrame, StereoRig
from vergence_service.app.server import Running, drain

FRAMES = make_frames(6)
EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)


def http_client(server: Running) -> DepthClient:
    return DepthClient(f"http://{server.http_address}")


async def step(session: DepthSession, frame: StereoFrame) -> DisparityMap:
    return await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


async def stepped(client: DepthClient) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    async with client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session:
        results = await asyncio.gather(*(step(session, frame) for frame in FRAMES))
        return [each.disparity_px for each in results]


async def test_every_door_gives_the_same_disparity() -> None:
    async with running_server(RecallModel()) as server:
        async with http_client(server) as client:
            over_http = await stepped(client)
        async with DepthClient(f"grpc://{server.grpc_address}") as client:
            over_grpc = await stepped(client)
        async with http_to(server) as web:
            job = await submit(web, zip_bytes(sequence_files(FRAMES)))
            await ended(web, job["id"])
            in_batch = await disparities(web, job["id"])
    np.testing.assert_array_equal(over_http, over_grpc)
    # Jobs keep their maps at 1/64 px.
    np.testing.assert_array_equal(np.rint(np.multiply(over_http, 64)) / 64, in_batch)


async def test_live_frames_come_back_and_the_stream_ends_with_the_session() -> None:
    async with running_server(RecallModel()) as server, http_client(server) as client:
        async with client.open_session(RIG, stream_id="headset") as session:
            frame = FRAMES[0]
            assert session.submit(frame.left, frame.right, frame.pose) == 1
            assert (await anext(session)).frame_id == 1
            assert (await client.stream_info("headset")).attached
        with pytest.raises(UnknownStream):
            await client.stream_info("headset")
        assert (await client.server_info()).model.name == "recall"


async def test_errors_are_those_that_the_server_raised() -> None:
    straight = StereoRig.from_rectified(RIG)
    backwards = StereoRig(straight.right, straight.left, straight.left_from_right.inverse())
    dark = make_frames(1)[0]
    dark.left[0, 0] = 254
    async with running_server(RecallModel()) as server, http_client(server) as client:
        with pytest.raises(BadCalibration, match="right camera to the right"):
            async with client.open_session(backwards):
                pass
        async with client.open_session(RIG, stream_id="mine") as session:
            with pytest.raises(StreamExists):
                async with client.open_session(RIG, stream_id="mine"):
                    pass
            with pytest.raises(NonFinite):
                await step(session, dark)
            assert (await step(session, FRAMES[1])).origin is Origin.RESET_NON_FINITE
            taken = client.open_session(RIG, stream_id="mine", resume_token=session.resume_token)
            async with taken as other:
                assert other.stream_id == "mine"
                with pytest.raises(Superseded):
                    await step(session, FRAMES[2])


async def test_a_session_resumes_over_a_connection_that_broke() -> None:
    events: list[SessionEvent] = []
    async with running_server(RecallModel()) as server:
        async with (
            proxy_to(server.http_address) as proxy,
            DepthClient(f"http://{proxy.address}") as client,
            client.open_session(RIG, output=EXACT, on_event=events.append) as session,
        ):
            results = [await step(session, frame) for frame in FRAMES[:3]]
            proxy.cut()
            proxy.mend()
            await eventually(lambda: EventKind.RESUMED in [event.kind for event in events])
            results += [await step(session, frame) for frame in FRAMES[3:]]
        async with DepthClient(f"grpc://{server.grpc_address}") as client:
            undisturbed = await stepped(client)
    assert results[3].origin is Origin.RESUMED
    np.testing.assert_array_equal([each.disparity_px for each in results], undisturbed)


async def test_a_client_that_vanished_leaves_its_stream_to_another() -> None:
    async with running_server(RecallModel()) as server, http_client(server) as client:
        async with http_client(server) as vanished:
            session = vanished.open_session(RIG, stream_id="roaming")
            await session.__aenter__()
            await step(session, FRAMES[0])
            token = session.resume_token

        stream = server.engine.streams.get("roaming")
        await eventually(lambda: stream.attachment is None)
        taken = client.open_session(RIG, stream_id="roaming", resume_token=token)
        async with taken as again:
            assert (await step(again, FRAMES[1])).origin is Origin.RESUMED
        await session.__aexit__(None, None, None)


async def test_a_draining_server_says_so_and_ends_the_call() -> None:
    events: list[SessionEvent] = []
    async with (
        running_server(RecallModel()) as server,
        http_client(server) as client,
        client.open_session(RIG, on_event=events.append, on_lost="raise") as session,
    ):
        await step(session, FRAMES[0])
        await drain(server, within_s=0.1)
        with pytest.raises(Draining):
            await step(session, FRAMES[1])
    assert EventKind.DRAINING in [event.kind for event in events]


async def test_a_server_that_is_none_of_ours_is_recognised() -> None:
    async with asyncio.timeout(10):
        listener = await asyncio.start_server(_answers_like_a_stranger, "127.0.0.1", 0)
        port = listener.sockets[0].getsockname()[1]
        async with listener, DepthClient(f"http://127.0.0.1:{port}") as client:
            with pytest.raises(NotReady, match="does not offer Vergence streams"):
                await client.server_info()
    async with DepthClient(f"http://127.0.0.1:{port}") as client:
        with pytest.raises(ConnectionLost):
            await client.server_info()


async def _answers_like_a_stranger(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    await reader.readuntil(b"\r\n\r\n")
    writer.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
    await writer.drain()
    writer.close()
