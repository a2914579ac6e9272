"""Bad input: each kind has its own clear error, and harms neither its stream nor the neighbours."""

import ast
import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import grpc
import httpx
import numpy as np
import pytest
from google.rpc import error_details_pb2

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.models import NOT_FINITE, RAISES, RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of, unpack_detail
from vergence import DepthClient
from vergence_proto import codec
from vergence_proto.errors import ERROR_CLASSES, BadImage, BadPose, ErrorCode, Quota
from vergence_proto.types import ImageEncoding, StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.app import Running
from vergence_service.transports.grpc_errors import GRPC_STATUS

Spoil = Callable[[pb.Frame], object]


def test_every_error_code_has_a_grpc_status() -> None:
    assert set(GRPC_STATUS) == set(ErrorCode)


def test_every_error_code_is_given_by_something() -> None:
    called = {
        call.func.id
        for path in (Path(__file__).parents[2] / "service" / "vergence_service").rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
    }
    # What is wrong with a message is found by the contract, for both sides.
    by_the_contract = {BadImage, BadPose}
    missing = {each for each in ERROR_CLASSES.values() if each.__name__ not in called}
    assert missing <= by_the_contract


def truncated_jpeg(frame: pb.Frame) -> None:
    pixels = np.frombuffer(frame.left.data, np.uint8).reshape(RIG.height, RIG.width, 3)
    file = cv2.imencode(".jpg", pixels)[1].tobytes()
    frame.left.encoding = pb.IMAGE_ENCODING_JPEG
    frame.left.data = file[: len(file) // 2]


def wrong_size(frame: pb.Frame) -> None:
    small = make_frame(2, rig=replace(RIG, height=24))
    frame.CopyFrom(codec.frame_to_proto(small, encoding=ImageEncoding.RAW))


def different_sizes(frame: pb.Frame) -> None:
    frame.right.height = 24
    frame.right.data = frame.right.data[: len(frame.right.data) // 2]


def nan_pose(frame: pb.Frame) -> None:
    frame.pose.world_from_left.position_m.y = float("nan")


def long_quaternion(frame: pb.Frame) -> None:
    frame.pose.world_from_left.orientation.w = 2.0


def first_pixel(value: int) -> Spoil:
    def spoil(frame: pb.Frame) -> None:
        frame.left.data = bytes([value]) + frame.left.data[1:]

    return spoil


def out_of_order(frame: pb.Frame) -> None:
    frame.frame_id = 1


def too_large(frame: pb.Frame) -> None:
    frame.left.data = bytes((1 << 20) + 1)


@pytest.mark.parametrize(
    ("spoil", "reason", "says"),
    [
        pytest.param(truncated_jpeg, "BAD_IMAGE", "left image", id="truncated-jpeg"),
        pytest.param(wrong_size, "BAD_SHAPE", "64x48", id="wrong-size"),
        pytest.param(different_sizes, "BAD_SHAPE", "64x24", id="different-sizes"),
        pytest.param(nan_pose, "BAD_POSE", "nan", id="nan-pose"),
        pytest.param(long_quaternion, "BAD_POSE", "unit", id="non-unit-quaternion"),
        pytest.param(out_of_order, "FRAME_OUT_OF_ORDER", "above 1", id="out-of-order"),
        pytest.param(too_large, "FRAME_TOO_LARGE", "1048576", id="too-large"),
        pytest.param(first_pixel(RAISES), "MODEL_FAILED", "as it was", id="model-raises"),
        pytest.param(first_pixel(NOT_FINITE), "NON_FINITE", "finite", id="not-finite"),
    ],
)
async def test_a_bad_frame_is_answered_in_band_and_harms_nobody(
    spoil: Spoil, reason: str, says: str
) -> None:
    async def good(call: RawCall, frame_id: int) -> pb.DisparityMap:
        return (await call.ask(frame_message(make_frame(frame_id)))).disparity

    async with (
        running_server(RecallModel(), grpc__max_frame_mib=1) as server,
        raw_stream(server, "hit") as hit,
        raw_stream(server, "neighbour") as neighbour,
    ):
        for call in (hit, neighbour):
            await good(call, 1)
        bad = frame_message(make_frame(2))
        spoil(bad.frame)
        error = (await hit.ask(bad)).frame_error
        after, undisturbed = await good(hit, 3), await good(neighbour, 3)

    assert (error.frame_id, error.reason) == (bad.frame.frame_id, reason)
    assert says in error.message
    assert "secret" not in error.message
    assert undisturbed.step_count == 2
    if reason == "NON_FINITE":
        assert (after.step_count, after.origin) == (1, pb.ORIGIN_RESET_NON_FINITE)
    else:
        assert (after.step_count, after.frames_skipped) == (2, 1)
        assert after.disparity.data == undisturbed.disparity.data


def zero_baseline(opening: pb.OpenStream) -> None:
    opening.rig.left_from_right.position_m.x = 0.0


def swapped_cameras(opening: pb.OpenStream) -> None:
    opening.rig.left_from_right.position_m.x = -0.1


def no_focal_length(opening: pb.OpenStream) -> None:
    opening.rig.right.fx = 0.0


def too_many_pixels(opening: pb.OpenStream) -> None:
    for camera in (opening.rig.left, opening.rig.right):
        camera.width, camera.height = 100_000, 100_000


def taken_id(opening: pb.OpenStream) -> None:
    opening.stream_id = "taken"


def bad_id(opening: pb.OpenStream) -> None:
    opening.stream_id = "../../etc"


def resume_unknown(opening: pb.OpenStream) -> None:
    opening.stream_id = "nowhere"
    opening.resume_token = b"0123456789abcdef"


def resume_with_wrong_token(opening: pb.OpenStream) -> None:
    opening.stream_id = "taken"
    opening.resume_token = b"0123456789abcdef"


@pytest.mark.parametrize(
    ("spoil", "status", "reason", "says"),
    [
        (zero_baseline, grpc.StatusCode.INVALID_ARGUMENT, "BAD_CALIBRATION", "baseline"),
        (swapped_cameras, grpc.StatusCode.INVALID_ARGUMENT, "BAD_CALIBRATION", "to the right"),
        (no_focal_length, grpc.StatusCode.INVALID_ARGUMENT, "BAD_CALIBRATION", "right camera"),
        (too_many_pixels, grpc.StatusCode.RESOURCE_EXHAUSTED, "FRAME_TOO_LARGE", "pixels"),
        (taken_id, grpc.StatusCode.ALREADY_EXISTS, "STREAM_EXISTS", "resume"),
        (bad_id, grpc.StatusCode.INVALID_ARGUMENT, "BAD_SHAPE", "characters"),
        (resume_unknown, grpc.StatusCode.NOT_FOUND, "STREAM_UNKNOWN", "nowhere"),
        (resume_with_wrong_token, grpc.StatusCode.ALREADY_EXISTS, "STREAM_EXISTS", "token"),
    ],
    ids=lambda value: getattr(value, "__name__", "") if callable(value) else "",
)
async def test_a_bad_opening_ends_the_call_with_its_reason(
    spoil: Callable[[pb.OpenStream], None], status: grpc.StatusCode, reason: str, says: str
) -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, "taken") as neighbour,
        connected(server) as stub,
    ):
        await neighbour.ask(frame_message(make_frame(1)))
        opening = open_message("new")
        spoil(opening.open)
        call = RawCall(stub.StreamDepth())
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.ask(opening)
        assert failure.value.code() is status
        assert reason_of(failure.value) == reason
        assert says in (failure.value.details() or "")
        after = await neighbour.ask(frame_message(make_frame(2)))
        assert after.disparity.step_count == 2
        assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_open == 1


async def ends_with(call: RawCall, message: pb.StreamDepthRequest) -> str:
    with pytest.raises(grpc.aio.AioRpcError) as failure:
        await call.ask(message)
    return reason_of(failure.value)


async def test_a_call_must_begin_by_opening() -> None:
    async with running_server(RecallModel()) as server, connected(server) as stub:
        call = RawCall(stub.StreamDepth())
        assert await ends_with(call, frame_message(make_frame(1))) == "STREAM_UNKNOWN"


async def test_a_call_opens_one_stream() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        assert await ends_with(call, open_message("second")) == "STREAM_EXISTS"


async def test_a_message_without_content_ends_the_call() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        assert await ends_with(call, pb.StreamDepthRequest()) == "BAD_SHAPE"


@pytest.mark.parametrize("opened", [False, True], ids=["at-first", "later"])
async def test_bytes_that_are_no_message_end_the_call_and_keep_the_stream(opened: bool) -> None:
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
        connected(server) as stub,
    ):
        # Typed stubs cannot send what is no message, so this channel speaks bytes.
        speak: Any = channel.stream_stream
        call = speak("/vergence.v1.DepthService/StreamDepth")()
        if opened:
            await call.write(open_message("mine").SerializeToString())
            await call.read()
        await call.write(b"\xff\xff\xff nonsense")
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await asyncio.wait_for(call.read(), 10)
        assert failure.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert reason_of(failure.value) == "BAD_SHAPE"
        info = await stub.GetServerInfo(pb.GetServerInfoRequest())
        assert info.streams_open == int(opened)


async def test_a_message_far_over_the_limit_ends_the_call_and_keeps_the_stream() -> None:
    async with (
        running_server(RecallModel(), grpc__max_frame_mib=1) as server,
        raw_stream(server, "mine") as call,
        connected(server) as stub,
    ):
        await call.ask(frame_message(make_frame(1)))
        huge = frame_message(make_frame(2))
        huge.frame.left.data = bytes(4 << 20)
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.ask(huge)
        assert failure.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        token = call.opened.resume_token
        async with raw_stream(server, "mine", resume_token=token) as again:
            assert (again.opened.resumed, again.opened.last_frame_id) == (True, 1)
        assert (await stub.GetServerInfo(pb.GetServerInfoRequest())).streams_open == 1


@pytest.mark.parametrize("method", ["GetStream", "ResetStream", "CloseStream"])
async def test_an_unknown_stream_is_told_as_such(method: str) -> None:
    async with running_server(RecallModel()) as server, connected(server) as stub:
        request = getattr(pb, f"{method}Request")(stream_id="nowhere")
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await getattr(stub, method)(request)
        assert failure.value.code() is grpc.StatusCode.NOT_FOUND
        assert reason_of(failure.value) == "STREAM_UNKNOWN"


async def test_a_full_server_says_when_to_come_back() -> None:
    async with (
        running_server(RecallModel(), streams__capacity=1) as server,
        raw_stream(server),
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message())
    assert reason_of(failure.value) == "STREAM_LIMIT"
    retry = error_details_pb2.RetryInfo()
    unpack_detail(failure.value, retry)
    assert 0 < retry.retry_delay.seconds <= 60


async def test_a_client_that_has_its_share_is_told_so_and_leaves_room_to_others() -> None:
    async with (
        running_server(RecallModel(), streams__per_client=1) as server,
        raw_stream(server, "mine") as mine,
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message())
        assert reason_of(failure.value) == "QUOTA"
        retry = error_details_pb2.RetryInfo()
        unpack_detail(failure.value, retry)
        assert 0 < retry.retry_delay.seconds <= 60
        # A share is an address's, by whatever door; to come back to what one has takes no other.
        async with DepthClient(f"http://{server.http_address}") as same:
            with pytest.raises(Quota, match=r"127\.0\.0\.1 holds 1 streams"):
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
        running_server(RecallModel(), streams__max_state_mib=1) as server,
        raw_stream(server, rig=large),
        connected(server) as stub,
    ):
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message(rig=large))
    assert reason_of(failure.value) == "STATE_MEMORY"


async def still_serves(server: Running) -> bool:
    async with raw_stream(server) as call:
        return (await call.ask(frame_message(make_frame(1)))).HasField("disparity")


async def test_http_on_the_grpc_port_is_cut_and_harms_nobody() -> None:
    async with running_server(RecallModel()) as server:
        host, port = server.grpc_address.rsplit(":", 1)
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        rest = await asyncio.wait_for(reader.read(), 10)
        writer.close()
        assert not rest.startswith(b"HTTP/1.1 200")
        assert await still_serves(server)


async def test_grpc_on_the_http_port_fails_at_once_and_harms_nobody() -> None:
    async with running_server(RecallModel()) as server:
        async with connected(replace(server, grpc_address=server.http_address)) as stub:
            with pytest.raises(grpc.aio.AioRpcError) as failure:
                await stub.GetServerInfo(pb.GetServerInfoRequest(), timeout=10)
        assert failure.value.code() is grpc.StatusCode.UNAVAILABLE
        assert await still_serves(server)
