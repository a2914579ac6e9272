"""The live call over a real gRPC server: answers, order, freshness, flow."""

import asyncio
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.frames import RIG, frame_message, make_frame
from tests.support.models import RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.weights_copy import WEIGHTS
from vergence_proto import codec
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir

END = pb.StreamDepthRequest(end=pb.End())
RESET = pb.StreamDepthRequest(reset=pb.Reset())


async def answers_until_end(call: RawCall) -> list[pb.StreamDepthResponse]:
    answers = []
    while (answer := await call.receive()) is not None:
        answers.append(answer)
    return answers


def frame_ids_answered(answers: list[pb.StreamDepthResponse]) -> list[int]:
    ids: list[int] = []
    for answer in answers:
        match answer.WhichOneof("message"):
            case "disparity":
                ids.append(answer.disparity.frame_id)
            case "frame_error":
                ids.append(answer.frame_error.frame_id)
            case "frames_dropped":
                ids.extend(answer.frames_dropped.frame_ids)
    return ids


async def test_streamed_equals_the_model_run_offline() -> None:
    frames = [make_frame(i, brightness=40 + i) for i in range(1, 8)]
    model = RecallModel()
    state: RecurrentState | None = None
    offline = []
    for frame in frames:
        assert frame.pose is not None
        view = StereoView(
            frame.left, frame.right, RIG, frame.capture_ns, frame.pose.world_from_left
        )
        [result] = model.step([Step(view, state, 4 if state is None else 1)])
        state = result.state
        offline.append(result.offset_px)

    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        for frame, expected in zip(frames, offline, strict=True):
            answer = (await call.ask(frame_message(frame))).disparity
            disparity = codec.disparity_from_proto(answer, RIG)
            assert (disparity.frame_id, disparity.capture_ns) == (frame.frame_id, frame.capture_ns)
            np.testing.assert_array_equal(disparity.disparity_px, expected)


async def test_two_clients_at_once_get_what_each_gets_alone() -> None:
    async def walk(call: RawCall, brightness: int) -> list[bytes]:
        maps = []
        for i in range(1, 11):
            answer = await call.ask(frame_message(make_frame(i, brightness=brightness)))
            maps.append(answer.disparity.disparity.data)
        return maps

    async with running_server(RecallModel(), model__max_batch=4) as server:
        async with raw_stream(server) as one, raw_stream(server) as other:
            together = await asyncio.gather(walk(one, 20), walk(other, 160))
        alone = []
        for brightness in (20, 160):
            async with raw_stream(server) as call:
                alone.append(await walk(call, brightness))
    assert alone == list(together)


async def test_the_newest_frame_wins_and_every_frame_is_answered_once() -> None:
    model = RecallModel()
    async with running_server(model) as server, raw_stream(server, every=False) as call:
        with model.busy():
            await call.send(frame_message(make_frame(1)))
            await asyncio.to_thread(model.wait_until_entered)
            for i in range(2, 9):
                await call.send(frame_message(make_frame(i)))
            # Each of them displaces the one before; when the last drop is reported, 8 is waiting.
            dropped = [await call.receive() for _ in range(6)]
        await call.send(END)
        answers = [answer for answer in dropped if answer is not None]
        answers += await answers_until_end(call)

    maps = [answer.disparity for answer in answers if answer.HasField("disparity")]
    assert sorted(frame_ids_answered(answers)) == list(range(1, 9))
    assert [answer.frame_id for answer in maps] == [1, 8]
    assert (maps[1].frames_skipped, maps[1].step_count) == (6, 2)
    assert model.batches == [1, 1]


async def test_a_lossless_stream_makes_the_sender_wait_and_loses_nothing() -> None:
    model = RecallModel()
    async with (
        running_server(model, streams__waiting_frames=2) as server,
        raw_stream(server) as call,
    ):

        async def send_all() -> None:
            for i in range(1, 41):
                await call.send(frame_message(make_frame(i)))
            await call.send(END)

        sending = asyncio.create_task(send_all())
        answers = await answers_until_end(call)
        await sending
    maps = [answer.disparity for answer in answers if answer.HasField("disparity")]
    assert [answer.frame_id for answer in maps] == list(range(1, 41))
    assert {answer.frames_skipped for answer in maps} == {0}


async def test_a_client_that_does_not_read_is_not_sent_what_is_old_by_then() -> None:
    rig = RectifiedRig(640, 480, 500.0, 500.0, 319.5, 319.5, 239.5, 0.1)  # 1.2 MB a map
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, every=False, rig=StereoRig.from_rectified(rig)) as call,
    ):
        for i in range(1, 31):
            await call.send(frame_message(make_frame(i, rig=rig)))
        await call.send(END)
        answers = await answers_until_end(call)
    maps = [answer.disparity.frame_id for answer in answers if answer.HasField("disparity")]
    assert sorted(frame_ids_answered(answers)) == list(range(1, 31))
    assert maps == sorted(maps)
    assert maps[-1] == 30
    # What the client's gRPC takes without being read, one map on its way, one in the making.
    assert len(maps) < 10


@pytest.mark.parametrize(
    ("weights", "name"),
    [
        # Another test streams these weights too, one client at a time.
        pytest.param(packaged_weights_dir(), "lite", marks=pytest.mark.slow),
        (WEIGHTS, "staged"),
    ],
    ids=["the weights that ship", "side by side"],
)
async def test_two_clients_at_once_get_what_each_gets_alone_from_real_graphs(
    weights: Path, name: str
) -> None:
    rig = RectifiedRig(256, 128, 200.0, 200.0, 127.5, 127.5, 63.5, 0.1)
    opening: dict[str, Any] = {"rig": StereoRig.from_rectified(rig)}

    async def walk(call: RawCall, brightness: int) -> list[bytes]:
        frames = (make_frame(i, brightness=brightness, rig=rig) for i in range(1, 6))
        answers = [await call.ask(frame_message(frame)) for frame in frames]
        return [answer.disparity.disparity.data for answer in answers]

    model = OnnxStereoModel(weights, name, providers=["cpu"], threads=2, allow_spinning=False)
    with closing(model):
        async with running_server(model, model__max_batch=4) as server:
            async with raw_stream(server, **opening) as one, raw_stream(server, **opening) as other:
                together = await asyncio.gather(walk(one, 20), walk(other, 160))
            alone = []
            for brightness in (20, 160):
                async with raw_stream(server, **opening) as call:
                    alone.append(await walk(call, brightness))
    assert alone == list(together)
    assert all(len(data) == 4 * rig.width * rig.height for walked in alone for data in walked)


async def test_frames_after_a_reset_start_from_nothing() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        first = (await call.ask(frame_message(make_frame(1)))).disparity
        await call.send(RESET)
        again = (await call.ask(frame_message(make_frame(2)))).disparity
        assert (again.origin, again.step_count) == (pb.ORIGIN_RESET_REQUESTED, 1)
        assert again.disparity.data == first.disparity.data


async def test_a_reset_is_owed_to_the_frame_that_displaces_the_one_it_was_for() -> None:
    model = RecallModel()
    async with running_server(model) as server, raw_stream(server, every=False) as call:
        with model.busy():
            await call.send(frame_message(make_frame(1)))
            await asyncio.to_thread(model.wait_until_entered)
            await call.send(RESET)
            await call.send(frame_message(make_frame(2)))
            dropped = await call.ask(frame_message(make_frame(3)))
        assert list(dropped.frames_dropped.frame_ids) == [2]
        assert (await call.receive()).disparity.frame_id == 1  # type: ignore[union-attr]
        assert (await call.receive()).disparity.origin == pb.ORIGIN_RESET_REQUESTED  # type: ignore[union-attr]


async def test_end_answers_what_was_sent_and_frees_the_stream() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, "mine") as call:
        for i in range(1, 4):
            await call.send(frame_message(make_frame(i)))
        await call.send(END)
        assert frame_ids_answered(await answers_until_end(call)) == [1, 2, 3]
        async with connected(server) as stub:
            assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_open == 0


async def test_answers_say_when_a_request_arrived_on_one_clock() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        await call.send(pb.StreamDepthRequest(ping=pb.Ping(client_ns=1)))
        await call.send(frame_message(make_frame(1)))
        pong, answer = [await call.receive() for _ in range(2)]
        await call.send(pb.StreamDepthRequest(ping=pb.Ping(client_ns=2)))
        later = await call.receive()
    assert pong is not None
    assert answer is not None
    assert later is not None
    received = [
        pong.pong.received_ns,
        answer.disparity.received_ns,
        answer.disparity.received_ns + answer.disparity.timings.total_us * 1000,
        later.pong.received_ns,
    ]
    assert received == sorted(received)
    assert received[0] > 0


async def test_a_frame_may_ask_for_fewer_pixels_than_its_stream() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        message = frame_message(make_frame(1))
        message.frame.map_step = 4
        small = await call.ask(message)
        whole = await call.ask(frame_message(make_frame(2)))
        message = frame_message(make_frame(3))
        message.frame.map_step = 3
        refused = await call.ask(message)
    assert (small.disparity.map_step, small.disparity.disparity.width) == (4, RIG.width // 4)
    assert (whole.disparity.map_step, whole.disparity.disparity.width) == (0, RIG.width)
    assert "map_step" in refused.frame_error.message


async def test_a_ping_reports_how_long_it_was_held() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        answer = await call.ask(pb.StreamDepthRequest(ping=pb.Ping(client_ns=42)))
        assert answer.pong.client_ns == 42
        assert 0 <= answer.pong.server_hold_ns < 10**9


async def test_a_map_carries_sigma_and_confidence_where_asked() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, sigma=True) as call:
        answer = (await call.ask(frame_message(make_frame(1)))).disparity
        disparity = codec.disparity_from_proto(answer, RIG)
        assert disparity.sigma_px is not None
        assert disparity.confidence is not None
        np.testing.assert_array_equal(disparity.sigma_px, np.float32(0.5))
        # A Laplace distribution of scale 0.5 px has 1 - exp(-2) of its mass within one pixel.
        assert set(np.unique(disparity.confidence)) == {round((1 - np.exp(-2)) * 255)}


async def test_the_timings_of_a_frame_add_up() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        timings = (await call.ask(frame_message(make_frame(1)))).disparity.timings
        parts = timings.decode_us + timings.queue_us + timings.model_us + timings.encode_us
        assert timings.model_us > 0
        assert parts <= timings.total_us + 4  # each is rounded


async def test_get_stream_describes_a_stream_without_touching_it() -> None:
    async with (
        running_server(RecallModel()) as server,
        connected(server) as stub,
        raw_stream(server, "mine") as call,
    ):
        await call.ask(frame_message(make_frame(1)))
        await call.ask(frame_message(make_frame(7)))
        stream = await stub.GetStream(
            pb.GetStreamRequest(stream_id="mine", resume_token=call.opened.resume_token)
        )
    assert (stream.attached, stream.frames_stepped, stream.last_frame_id) == (True, 2, 7)
    assert (stream.step_count, stream.state_bytes) == (2, 4 * RIG.width * RIG.height)
    assert codec.rectified_rig_from_proto(stream.rig) == RIG


async def test_reset_and_close_work_from_any_connection() -> None:
    async with (
        running_server(RecallModel()) as server,
        connected(server) as stub,
        raw_stream(server, "mine") as call,
    ):
        await call.ask(frame_message(make_frame(1)))
        await stub.ResetStream(
            pb.ResetStreamRequest(stream_id="mine", resume_token=call.opened.resume_token)
        )
        answer = await call.ask(frame_message(make_frame(2)))
        assert answer.disparity.origin == pb.ORIGIN_RESET_REQUESTED
        await stub.CloseStream(
            pb.CloseStreamRequest(stream_id="mine", resume_token=call.opened.resume_token)
        )
        assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_open == 0


@pytest.mark.parametrize("stream_id", ["", "kitchen-2"], ids=["chosen-by-server", "given"])
async def test_an_opening_is_answered_with_all_that_a_client_needs(stream_id: str) -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, stream_id) as call:
        opened = call.opened
        assert opened.stream_id == stream_id or (not stream_id and opened.stream_id)
        assert codec.rectified_rig_from_proto(opened.rig) == RIG
        assert (opened.credit, opened.resumed, opened.last_frame_id) == (2, False, 0)
        assert (opened.detach_grace_s, opened.idle_timeout_s) == (10, 60)
        assert (opened.model.name, list(opened.model.iterations)) == ("recall", [1, 4])
        assert len(opened.resume_token) == 16
