"""The frames of one connection that wait, not decoded yet, for their step."""

import asyncio
from collections import deque
from dataclasses import dataclass, replace

from vergence_proto.codec import ReceivedFrame
from vergence_proto.errors import FrameOutOfOrder
from vergence_proto.types import Delivery
from vergence_service.process.memory import MemoryHold


@dataclass(frozen=True, slots=True, eq=False)
class QueuedFrame:
    """A frame as it arrived."""

    frame: ReceivedFrame
    arrived_s: float
    memory: MemoryHold
    reset_before: bool = False  # the client asked for a reset just before this frame

    @property
    def frame_id(self) -> int:
        return self.frame.frame_id


class Mailbox:
    """A queue of frames between one reader, which puts, and one stepper, which takes.

    NEWEST holds one frame, and a newer frame displaces it, so the stepper never takes an old frame.
    EVERY holds ``capacity`` frames; then the reader waits, and so does the sender.
    """

    def __init__(self, delivery: Delivery, *, capacity: int) -> None:
        self._displaces = delivery is Delivery.NEWEST
        self._capacity = 1 if self._displaces else capacity
        self._frames: deque[QueuedFrame] = deque()
        self._reset_asked = False
        self._finished = False
        self._changed = asyncio.Condition()

    async def put(self, queued: QueuedFrame) -> QueuedFrame | None:
        """Add a frame; return the frame that it displaced, if any.

        Raises FrameOutOfOrder, because an older frame must not displace a newer one.
        """
        async with self._changed:
            if self._frames and queued.frame_id <= self._frames[-1].frame_id:
                raise FrameOutOfOrder(
                    f"expected a frame_id above {self._frames[-1].frame_id}, which is waiting, "
                    f"got {queued.frame_id}"
                )
            displaced: QueuedFrame | None = None
            if self._displaces and self._frames:
                displaced = self._frames.popleft()
            await self._changed.wait_for(lambda: len(self._frames) < self._capacity)
            # A reset before a displaced frame still applies to the next frame.
            reset_before = self._reset_asked or (displaced is not None and displaced.reset_before)
            self._frames.append(replace(queued, reset_before=reset_before))
            self._reset_asked = False
            self._changed.notify_all()
            return displaced

    @property
    def holds_frame(self) -> bool:
        """True while a frame waits."""
        return bool(self._frames)

    def reset(self) -> None:
        """Mark the next frame: the stream starts again without a state before it."""
        self._reset_asked = True

    def discard(self) -> None:
        """Forget the frames that wait, and give their memory back."""
        for queued in self._frames:
            queued.memory.release()
        self._frames.clear()

    async def finish(self) -> None:
        """Accept no more frames; waiting frames can still be taken."""
        async with self._changed:
            self._finished = True
            self._changed.notify_all()

    async def filled(self) -> bool:
        """Wait until a frame waits, and return True; False if no more frames come."""
        async with self._changed:
            await self._changed.wait_for(lambda: bool(self._frames) or self._finished)
            return bool(self._frames)

    async def take(self) -> QueuedFrame | None:
        """Wait for the oldest frame and return it, or None if no more frames come."""
        async with self._changed:
            await self._changed.wait_for(lambda: bool(self._frames) or self._finished)
            queued = self._frames.popleft() if self._frames else None
            self._changed.notify_all()
            return queued
