"""Lost or late: what a call over Zenoh concludes from what comes."""

import pytest

from vergence.transports.zenoh_losses import Unanswered
from vergence_proto.v1 import depth_pb2 as pb


def a_map(frame_id: int) -> pb.StreamDepthResponse:
    return pb.StreamDepthResponse(disparity=pb.DisparityMap(frame_id=frame_id))


def a_pong(client_ns: int, *waiting: int) -> pb.StreamDepthResponse:
    pong = pb.Pong(client_ns=client_ns, unanswered_frame_ids=waiting)
    return pb.StreamDepthResponse(pong=pong)


@pytest.fixture
def unanswered() -> Unanswered:
    """Frames 1 and 2, a ping at 100 ns, frame 3."""
    frames = Unanswered()
    frames.sent(1)
    frames.sent(2)
    frames.pinged(100)
    frames.sent(3)
    return frames


def test_a_map_proves_those_before_it_lost_and_none_after_it(unanswered: Unanswered) -> None:
    assert unanswered.answered(a_map(2)) == [1]
    assert unanswered.answered(a_map(3)) == []


def test_what_was_dropped_or_refused_is_not_lost(unanswered: Unanswered) -> None:
    refusal = pb.StreamDepthResponse(frame_error=pb.FrameError(frame_id=1))
    dropped = pb.StreamDepthResponse(frames_dropped=pb.FramesDropped(frame_ids=[2]))
    assert unanswered.answered(refusal) == unanswered.answered(dropped) == []
    assert unanswered.answered(a_map(3)) == []


def test_a_pong_separates_lost_from_late_among_the_frames_before_its_ping(
    unanswered: Unanswered,
) -> None:
    assert unanswered.answered(a_pong(100, 2)) == [1]
    assert unanswered.answered(a_map(2)) == []
    unanswered.pinged(200)
    assert unanswered.answered(a_pong(200)) == [3]


def test_a_pong_to_no_ping_of_ours_proves_nothing(unanswered: Unanswered) -> None:
    assert unanswered.answered(a_pong(7)) == []
