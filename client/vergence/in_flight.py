"""The frames of a session that were sent and not answered, and the count of those dropped."""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from vergence.results import DepthResult, Drops

# Of a lossless session, so many answered frames are kept until the server has stored its state.
_MOST_KEPT = 32


@dataclass(frozen=True, slots=True, eq=False)
class FrameInFlight:
    """A frame that was sent and not answered yet."""

    frame_id: int
    request: bytes | Callable[[], bytes]
    """The serialized request, or the function that makes it, which works on whole images.

    It is used again after a reconnection.
    """
    answer: asyncio.Future[DepthResult] | None
    """The result that ``step`` waits for; None for a live frame, whose result is iterated."""
    reset_before: bool = False
    """The session's memory was discarded before this frame."""

    def fail(self, error: Exception) -> None:
        """Raise ``error`` in the ``step`` that waits for this frame, if one does."""
        if self.answer is not None and not self.answer.done():
            self.answer.set_exception(error)


class FramesInFlight:
    """Frames without an answer, in the order they were sent, at most ``credit`` of them."""

    def __init__(self) -> None:
        self.credit: int = 1
        self.drops: Drops = Drops()
        self._by_id: dict[int, FrameInFlight] = {}
        # Answered frames that another server would need again.
        self._kept: deque[FrameInFlight] = deque(maxlen=_MOST_KEPT)
        self._removed = asyncio.Event()

    @property
    def has_room(self) -> bool:
        """Return True if the credit allows one more frame."""
        return len(self._by_id) < self.credit

    async def wait_for_room(self) -> None:
        """Wait until the credit allows one more frame."""
        while not self.has_room:
            self._removed.clear()
            await self._removed.wait()

    def add(self, frame: FrameInFlight) -> None:
        """Record a frame that is sent now."""
        self._by_id[frame.frame_id] = frame

    def pop(self, frame_id: int) -> FrameInFlight | None:
        """Remove and return a frame that was answered; None if it was removed before."""
        frame = self._by_id.pop(frame_id, None)
        self._removed.set()
        return frame

    def fail(self, frames: Iterable[FrameInFlight], error: Exception) -> None:
        """Remove frames that will not be answered; live ones count as lost."""
        for frame in frames:
            self.pop(frame.frame_id)
            if frame.answer is None:
                self.count(lost=1)
            frame.fail(error)

    def keep(self, frame: FrameInFlight) -> None:
        """Keep an answered frame, to send it again to a server that has an earlier state."""
        self._kept.append(frame)

    def forget_kept(self, *, up_to: int | None = None) -> None:
        """Forget the kept frames up to an id, or all of them."""
        while self._kept and (up_to is None or self._kept[0].frame_id <= up_to):
            self._kept.popleft()

    def is_wanted(self, frame_id: int) -> bool:
        """Return True if the frame has no answer yet, or is kept."""
        return frame_id in self._by_id or any(frame.frame_id == frame_id for frame in self._kept)

    def to_send_again(self) -> list[FrameInFlight]:
        """Return the kept frames and those without an answer, in the order they were sent."""
        return sorted([*self._kept, *self._by_id.values()], key=lambda frame: frame.frame_id)

    def __len__(self) -> int:
        """Return the number of frames without an answer."""
        return len(self._by_id)

    def __contains__(self, frame_id: int) -> bool:
        """Return True if the frame has no answer yet."""
        return frame_id in self._by_id

    def in_order(self) -> list[FrameInFlight]:
        """Return all frames without an answer, in the order they were sent."""
        return list(self._by_id.values())

    def count(self, **dropped: int) -> None:
        """Add to the drops, by their field names."""
        self.drops = replace(
            self.drops, **{name: getattr(self.drops, name) + n for name, n in dropped.items()}
        )
