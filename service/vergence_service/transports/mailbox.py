"""Where the frames of one connection wait, undecoded, for their turn."""

import asyncio
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from vergence_proto.errors import FrameOutOfOrder
from vergence_proto.types import Delivery

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True, eq=False)
class Letter(Generic[Content]):
    """A frame as it arrived."""

    frame_id: int
    content: Content
    arrived_s: float
    reset_before: bool = False  # the client asked for it between the frame before and this one


class Mailbox(Generic[Content]):
    """One reader puts, one stepper takes.

    NEWEST holds one letter, which a newer one displaces, so what is taken is never old. EVERY
    holds ``capacity`` and then lets the reader wait, which in turn lets the sender wait.
    """

    def __init__(self, delivery: Delivery, *, capacity: int) -> None:
        self._displaces = delivery is Delivery.NEWEST
        self._capacity = 1 if self._displaces else capacity
        self._letters: deque[Letter[Content]] = deque()
        self._reset_asked = False
        self._finished = False
        self._changed = asyncio.Condition()

    async def put(self, letter: Letter[Content]) -> Letter[Content] | None:
        """Add a letter; the one that it displaced, if any.

        Raises FrameOutOfOrder: an older frame must not displace a newer one.
        """
        async with self._changed:
            if self._letters and letter.frame_id <= self._letters[-1].frame_id:
                raise FrameOutOfOrder(
                    f"expected a frame_id above {self._letters[-1].frame_id}, which is waiting, "
                    f"got {letter.frame_id}"
                )
            displaced: Letter[Content] | None = None
            if self._displaces and self._letters:
                displaced = self._letters.popleft()
            await self._changed.wait_for(lambda: len(self._letters) < self._capacity)
            # A reset that was asked for before a displaced frame is still owed to the next one.
            owed = self._reset_asked or (displaced is not None and displaced.reset_before)
            self._letters.append(replace(letter, reset_before=owed))
            self._reset_asked = False
            self._changed.notify_all()
            return displaced

    def reset(self) -> None:
        """The next letter put is to start from nothing."""
        self._reset_asked = True

    async def finish(self) -> None:
        """No letter follows; those that wait can still be taken."""
        async with self._changed:
            self._finished = True
            self._changed.notify_all()

    async def take(self) -> Letter[Content] | None:
        """The oldest letter, waiting for one; None when there will be no more."""
        async with self._changed:
            await self._changed.wait_for(lambda: bool(self._letters) or self._finished)
            letter = self._letters.popleft() if self._letters else None
            self._changed.notify_all()
            return letter
