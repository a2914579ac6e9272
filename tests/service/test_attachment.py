"""A stream keeps its state when its connection is lost, and the newest connection wins."""

import asyncio
from dataclasses import replace

import grpc
import pytest

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.server import ManualClock, RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.app.server import Running


async def detached(server: Running, stream_id: str) -> None:
    """Wait until the server has noticed that the connection is gone."""
    await eventually(lambda: server.engine.streams.get(stream_id).attachment is None)


async def reference_map() -> bytes:
    """The answer to frame 2 of an undisturbed stream."""
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        await call.ask(frame_message(make_frame(1)))
        return (await call.ask(frame_message(make_frame(2)))).disparity.disparity.data


async def test_a_resumed_stream_goes_on_from_the_state_it_had() -> None:
    clock = ManualClock()
    async with running_server(RecallModel(), clock=clock) as server:
        async with raw_stream(server, "mine") as call:
            await call.ask(frame_message(make_frame(1)))
            token = call.opened.resume_token
        await detached(server, "mine")
        clock.advance(9.9)
        async with raw_stream(server, "mine", resume_token=token) as call:
            assert (call.opened.resumed, call.opened.last_frame_id) == (True, 1)
            answer = (await call.ask(frame_message(make_frame(2)))).disparity
    assert (answer.origin, answer.step_count) == (pb.ORIGIN_RESUMED, 2)
    assert answer.disparity.data == await reference_map()


async def test_an_opening_whose_answer_was_lost_may_be_repeated_by_its_sender_only() -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, "mine", opening_id=b"secret") as lost,
    ):
        async with raw_stream(server, "mine", opening_id=b"secret") as call:
            assert call.opened.resume_token == lost.opened.resume_token
            assert not call.opened.resumed
            answer = (await call.ask(frame_message(make_frame(1)))).disparity
        assert (answer.origin, answer.step_count) == (pb.ORIGIN_COLD_START, 1)
        for guess in (b"", b"guess"):
            with pytest.raises(grpc.aio.AioRpcError, match="is open; resume it"):
                async with raw_stream(server, "mine", opening_id=guess):
                    pass


async def test_a_frame_that_was_in_the_model_when_the_client_was_lost_can_be_sent_again() -> None:
    model = RecallModel()
    async with running_server(model) as server:
        async with raw_stream(server, "mine") as call:
            await call.ask(frame_message(make_frame(1)))
            await asyncio.to_thread(model.wait_until_entered)
            token = call.opened.resume_token
            with model.busy():
                await call.send(frame_message(make_frame(2)))
                await asyncio.to_thread(model.wait_until_entered)
                call.call.cancel()
                await detached(server, "mine")
        async with raw_stream(server, "mine", resume_token=token) as call:
            assert call.opened.last_frame_id == 1
            answer = (await call.ask(frame_message(make_frame(2)))).disparity
    assert answer.step_count == 2
    assert answer.disparity.data == await reference_map()


async def test_past_the_grace_a_stream_is_expired_and_later_unknown() -> None:
    clock = ManualClock()
    async with running_server(RecallModel(), clock=clock) as server, connected(server) as stub:
        async with raw_stream(server, "mine") as call:
            token = call.opened.resume_token
        await detached(server, "mine")
        reasons = []
        for pause_s in (10.0, 299.0, 2.0):
            clock.advance(pause_s)
            server.engine.streams.sweep()
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await RawCall(stub.StreamDepth()).ask(open_message("mine", resume_token=token))
            assert failure.value.code() is grpc.StatusCode.NOT_FOUND
            reasons.append(reason_of(failure.value))
    assert reasons == ["STREAM_EXPIRED", "STREAM_EXPIRED", "STREAM_UNKNOWN"]


async def test_an_idle_stream_is_warned_and_then_expires() -> None:
    clock = ManualClock()
    async with (
        running_server(RecallModel(), clock=clock) as server,
        raw_stream(server, "mine") as call,
    ):
        clock.advance(51)
        server.engine.streams.sweep()
        warning = await call.receive()
        assert warning is not None
        assert warning.notice.kind == pb.NOTICE_KIND_EXPIRING
        assert warning.notice.in_s == pytest.approx(9)

        await call.ask(frame_message(make_frame(1)))  # a frame keeps it
        clock.advance(49)
        server.engine.streams.sweep()
        await call.ask(frame_message(make_frame(2)))

        clock.advance(60)
        server.engine.streams.sweep()
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.receive()
    assert reason_of(failure.value) == "STREAM_EXPIRED"


async def test_the_newest_attachment_wins_and_the_older_is_reported() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, "mine") as older:
        await older.ask(frame_message(make_frame(1)))
        token = older.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as newer:
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await older.receive()
            answer = (await newer.ask(frame_message(make_frame(2)))).disparity
            assert (answer.origin, answer.step_count) == (pb.ORIGIN_RESUMED, 2)
    assert failure.value.code() is grpc.StatusCode.ABORTED
    assert reason_of(failure.value) == "SUPERSEDED"


async def test_a_superseded_connection_steps_nothing_more() -> None:
    model = RecallModel()
    async with running_server(model) as server, raw_stream(server, "mine") as older:
        token = older.opened.resume_token
        with model.busy():
            for i in range(1, 4):
                await older.send(frame_message(make_frame(i)))
            await asyncio.to_thread(model.wait_until_entered)
            async with raw_stream(server, "mine", resume_token=token) as newer:
                assert newer.opened.last_frame_id == 0
                with pytest.raises(grpc.aio.AioRpcError):
                    await older.receive()
                model.let_go()
                answer = (await newer.ask(frame_message(make_frame(1)))).disparity
    assert (answer.frame_id, answer.step_count) == (1, 1)


async def test_a_resume_with_another_rig_is_refused_and_harms_nobody() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, "mine") as owner:
        other = StereoRig.from_rectified(replace(RIG, fx=61.0, fy=61.0))
        async with connected(server) as stub:
            request = open_message("mine", resume_token=owner.opened.resume_token, rig=other)
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await RawCall(stub.StreamDepth()).ask(request)
        assert reason_of(failure.value) == "BAD_CALIBRATION"
        assert (await owner.ask(frame_message(make_frame(1)))).HasField("disparity")


async def test_closing_a_stream_from_elsewhere_ends_its_call() -> None:
    async with (
        running_server(RecallModel()) as server,
        connected(server) as stub,
        raw_stream(server, "mine") as call,
    ):
        await stub.CloseStream(
            pb.CloseStreamRequest(stream_id="mine", resume_token=call.opened.resume_token)
        )
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.receive()
    assert reason_of(failure.value) == "STREAM_UNKNOWN"
