"""Requests are read from bytes within limits: only images may be large, and nothing is copied."""

import random
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.mutants import damaged
from vergence_proto import codec
from vergence_proto.codec.requests import MAX_SMALL_BYTES
from vergence_proto.errors import BadShape, DepthError, FrameTooLarge
from vergence_proto.v1 import depth_pb2 as pb

FRAME = frame_message(make_frame(7))
SMALL = [
    open_message("mine"),
    pb.StreamDepthRequest(ping=pb.Ping(client_ns=5)),
    pb.StreamDepthRequest(reset=pb.Reset()),
    pb.StreamDepthRequest(end=pb.End()),
]


@pytest.mark.parametrize("message", SMALL, ids=["open", "ping", "reset", "end"])
def test_a_small_message_is_read_as_protobuf_reads_it(message: pb.StreamDepthRequest) -> None:
    kind = message.WhichOneof("message")
    assert kind is not None
    assert codec.read_request(message.SerializeToString()) == getattr(message, kind)


def test_a_frame_is_read_as_protobuf_reads_it_and_its_images_are_views() -> None:
    data = FRAME.SerializeToString()
    received = codec.read_request(data)
    assert isinstance(received, codec.ReceivedFrame)
    assert isinstance(received.left.data, memoryview)
    assert received.left.data.obj is data
    assert bytes(received.left.data) == FRAME.frame.left.data
    assert bytes(received.right.data) == FRAME.frame.right.data
    assert received.left.header == pb.Image(
        encoding=FRAME.frame.left.encoding, width=RIG.width, height=RIG.height
    )
    decoded, expected = codec.decode_frame(received), codec.frame_from_proto(FRAME.frame)
    np.testing.assert_array_equal(decoded.left, expected.left)
    assert decoded.frame_id == expected.frame_id == 7
    assert decoded.pose is not None
    assert expected.pose is not None
    np.testing.assert_array_equal(
        decoded.pose.world_from_left.matrix, expected.pose.world_from_left.matrix
    )


@given(st.sampled_from([FRAME, *SMALL]), st.randoms(use_true_random=False), st.integers(1, 3))
def test_mutants_are_read_or_refused(
    message: pb.StreamDepthRequest, chance: random.Random, times: int
) -> None:
    data = message.SerializeToString()
    for _ in range(times):
        data = damaged(data, chance)
    try:
        received = codec.read_request(data)
        if isinstance(received, codec.ReceivedFrame):
            codec.check_frame(received, size=(RIG.width, RIG.height), max_bytes=1 << 20)
            decoded = codec.decode_frame(received)
            assert decoded.left.shape == decoded.right.shape == (RIG.height, RIG.width, 3)
    except DepthError:
        return


def twice(field: bytes) -> bytes:
    """A frame in which one field stands twice."""
    return (
        pb.StreamDepthRequest(frame=pb.Frame.FromString(b"")).SerializeToString()[:1]
        + bytes([2 * len(field)])
        + 2 * field
    )


BOMBS = {
    "one message, then another, a million times": b"\x0a\x00\x12\x00" * (1 << 20),
    "one message twice": b"\x1a\x00\x1a\x00",
    "unknown fields": b"\xf2\x06\x00" * (1 << 19),
    "a group": b"\x0b\x0c",
    "a field that is cut short": b"\x12\x7f",
    "an endless number": b"\x12" + b"\xff" * 20,
    "a number where a message belongs": b"\x08\x01",
    "an image twice": twice(b"\x1a\x00"),
    "an opening with a megabyte": b"\x0a\x80\x80\x40" + bytes(1 << 20),
    "a frame full of small fields": b"\x12\x80\x80\x40" + b"\x08\x01" * (1 << 19),
    "an image full of small fields": b"\x12\x84\x80\x40\x1a\x80\x80\x40" + b"\x08\x01" * (1 << 19),
    "nothing": b"",
}


@pytest.mark.parametrize("name", [*BOMBS])
def test_a_bomb_is_refused_and_costs_nothing(name: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((BadShape, FrameTooLarge)):
            codec.read_request(BOMBS[name])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8 * MAX_SMALL_BYTES


def test_fields_of_a_newer_version_are_passed_over() -> None:
    newer = b"\xfa\x06\x03abc"  # field 111
    inside = FRAME.frame.SerializeToString() + newer
    assert codec.read_frame(inside).frame_id == 7
    received = codec.read_request(newer + FRAME.SerializeToString() + newer)
    assert isinstance(received, codec.ReceivedFrame)
    assert received.frame_id == 7


def test_a_frame_has_no_more_bytes_than_its_pixels_can_need() -> None:
    frame = pb.Frame(frame_id=1)
    for image in (frame.left, frame.right):
        image.encoding, image.width, image.height = pb.IMAGE_ENCODING_PNG, RIG.width, RIG.height
        image.data = bytes(8 * RIG.width * RIG.height + (1 << 18) + 1)
    with pytest.raises(FrameTooLarge, match="for 64x48 pixels"):
        codec.check_frame(codec.ReceivedFrame.of(frame))
