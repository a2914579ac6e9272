"""The inbox between Zenoh's threads and the event loop: its order, its room, its drops."""

from collections.abc import AsyncIterator

import pytest

from vergence_proto.codec import ReceivedFrame
from vergence_proto.errors import Quota
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.inbox import Inbox
from vergence_proto.zenoh.session import ZenohSession, make_config

KEY = "vergence/v1/s/frames"


@pytest.fixture
async def peer() -> AsyncIterator[ZenohSession]:
    """A session with itself: what it puts is received before the put returns."""
    peer = ZenohSession(make_config(max_message_bytes=1 << 20, mode="peer", listen__endpoints=[]))
    await peer.open()
    yield peer
    await peer.close()


async def inbox_with(peer: ZenohSession, *messages: pb.Frame | pb.Reset, live: bool) -> Inbox:
    inbox = Inbox("mine", bulky=pb.Frame, max_bulky=1 if live else 2, drop_oldest=live)
    await peer.subscribe(KEY, inbox.put)
    for message in messages:
        await peer.put(KEY, message, attachment_id="mine")
    return inbox


async def next_frame_id(inbox: Inbox) -> int:
    received = await inbox.take()
    assert isinstance(received, ReceivedFrame)
    return received.frame_id


async def test_a_newer_frame_takes_the_place_of_one_and_a_reset_keeps_its_own(
    peer: ZenohSession,
) -> None:
    frames = [pb.Frame(frame_id=frame_id) for frame_id in (1, 2, 3)]
    inbox = await inbox_with(peer, frames[0], pb.Reset(), *frames[1:], live=True)
    assert await inbox.take() == pb.Reset()
    assert await next_frame_id(inbox) == 3


async def test_a_lossless_sender_past_its_credit_is_ended_after_what_it_was_owed(
    peer: ZenohSession,
) -> None:
    frames = [pb.Frame(frame_id=frame_id) for frame_id in (1, 2, 3)]
    inbox = await inbox_with(peer, *frames, live=False)
    assert [await next_frame_id(inbox), await next_frame_id(inbox)] == [1, 2]
    with pytest.raises(Quota, match="credit"):
        await inbox.take()


async def test_what_is_for_another_or_of_no_known_type_is_passed_over(peer: ZenohSession) -> None:
    inbox = await inbox_with(peer, live=False)
    await peer.put(KEY, pb.Frame(frame_id=1), attachment_id="another")
    await peer.put(KEY, pb.Vector3(x=1.0), attachment_id="mine")
    await peer.put(KEY, pb.Frame(frame_id=2), attachment_id="mine")
    assert await next_frame_id(inbox) == 2
