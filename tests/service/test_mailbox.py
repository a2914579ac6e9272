"""The mailbox between a reader and a stepper."""

import asyncio

import pytest
from prometheus_client import CollectorRegistry

from vergence_proto.codec import ReceivedFrame
from vergence_proto.errors import FrameOutOfOrder
from vergence_proto.types import Delivery
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.process.memory import MemoryBudget
from vergence_service.process.metrics import Metrics
from vergence_service.transports.mailbox import Mailbox, QueuedFrame

BUDGET = MemoryBudget(1 << 20, metrics=Metrics(CollectorRegistry()))


def queued(frame_id: int) -> QueuedFrame:
    frame = pb.Frame(frame_id=frame_id, capture_ns=frame_id * 1000)
    memory = BUDGET.hold_frame(1)
    return QueuedFrame(ReceivedFrame.of(frame), arrived_s=float(frame_id), memory=memory)


async def test_of_live_frames_the_newest_is_taken_and_each_other_given_back() -> None:
    mailbox = Mailbox(Delivery.NEWEST, capacity=8)
    displaced = [await mailbox.put(queued(i)) for i in range(1, 5)]
    assert [one and one.frame_id for one in displaced] == [None, 1, 2, 3]
    taken = await mailbox.take()
    assert taken is not None
    assert taken.frame.fields.capture_ns == 4000


async def test_an_older_frame_displaces_nothing() -> None:
    mailbox = Mailbox(Delivery.NEWEST, capacity=8)
    await mailbox.put(queued(5))
    with pytest.raises(FrameOutOfOrder, match="above 5"):
        await mailbox.put(queued(4))
    taken = await mailbox.take()
    assert taken is not None
    assert taken.frame_id == 5


async def test_lossless_frames_keep_their_order_and_the_reader_waits_for_room() -> None:
    mailbox = Mailbox(Delivery.EVERY, capacity=2)
    for i in (1, 2):
        assert await mailbox.put(queued(i)) is None
    third = asyncio.create_task(mailbox.put(queued(3)))
    await asyncio.sleep(0)
    assert not third.done()
    taken = [await mailbox.take()]
    await third
    taken += [await mailbox.take() for _ in range(2)]
    assert [one and one.frame_id for one in taken] == [1, 2, 3]


@pytest.mark.parametrize("delivery", list(Delivery), ids=lambda delivery: delivery.value)
async def test_what_waits_can_be_taken_after_the_end(delivery: Delivery) -> None:
    mailbox = Mailbox(delivery, capacity=2)
    await mailbox.put(queued(1))
    await mailbox.finish()
    taken = [await mailbox.take(), await mailbox.take()]
    assert [one and one.frame_id for one in taken] == [1, None]


async def test_a_taker_that_waits_learns_of_the_end() -> None:
    mailbox = Mailbox(Delivery.NEWEST, capacity=1)
    taking = asyncio.create_task(mailbox.take())
    await asyncio.sleep(0)
    await mailbox.finish()
    assert await taking is None


async def test_a_reset_belongs_to_the_next_frame_and_survives_its_displacement() -> None:
    mailbox = Mailbox(Delivery.NEWEST, capacity=1)
    await mailbox.put(queued(1))
    mailbox.reset()
    await mailbox.put(queued(2))
    await mailbox.put(queued(3))
    taken = await mailbox.take()
    await mailbox.put(queued(4))
    after = await mailbox.take()
    assert taken is not None
    assert after is not None
    assert (taken.reset_before, after.reset_before) == (True, False)
