"""Bad input: each kind has its own clear error, and harms neither its stream nor the neighbours."""

import ast
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import grpc
import numpy as np
import pytest

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.models import NO_MEMORY, NOT_FINITE, RAISES, RecallModel
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of
from vergence_proto.errors import ERROR_CLASSES, BadImage, BadPose, ErrorCode
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.transports.grpc.errors import GRPC_STATUS

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
    frame.CopyFrom(frame_message(small).frame)


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
        pytest.param(first_pixel(RAISES), "MODEL_FAILED", "unchanged", id="model-raises"),
        pytest.param(first_pixel(NO_MEMORY), "STATE_MEMORY", "nothing has changed", id="no-memory"),
        pytest.param(first_pixel(NOT_FINITE), "NON_FINITE", "finite", id="not-finite"),
    ],
)
async def test_a_bad_frame_is_answered_in_band_and_harms_nobody(
    spoil: Spoil, reason: str, says: str
) -> None:
    async def good(call: RawCall, frame_id: int) -> pb.DisparityMap:
        return (await call.ask(frame_message(make_frame(frame_id)))).disparity

    async with (
        running_server(RecallModel(), limits__max_frame_mib=1) as server,
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
