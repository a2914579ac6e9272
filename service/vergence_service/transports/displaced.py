"""The frames that a newer one displaced, until the client hears of them."""

import asyncio
from collections.abc import Callable

from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.transports.outbox import Outbox

# A client without credit says nothing for at most so long.
_LONGEST_S = 1.0


class DisplacedFrames:
    """Reports displaced frames, which gives the client credit for others.

    While a stream waits for its turn, reports wait too: a frame that is sent long before the turn
    would be displaced again. Shortly before the turn, one report lets the client send a new frame.
    """

    def __init__(self, outbox: Outbox, *, on_reported: Callable[[], None]) -> None:
        self._outbox = outbox
        self._on_reported = on_reported  # called for each frame
        self._frame_ids: list[int] = []
        self._waits = False  # for its turn
        self._due: asyncio.TimerHandle | None = None

    def wait(self) -> None:
        """Keep what is displaced from now on: the stream waits for its turn."""
        self._waits = True

    def begin(self) -> None:
        """Report what is displaced from now on: the stream has its turn."""
        self._waits = False

    async def add(self, frame_id: int) -> None:
        """Report a frame, now or later."""
        self._frame_ids.append(frame_id)
        if not self._waits:
            await self.report()
        elif self._due is None:
            loop = asyncio.get_running_loop()
            self._due = loop.call_later(_LONGEST_S, self.report_now)

    async def report(self) -> None:
        """Report all frames that were kept."""
        if message := self._taken():
            await self._outbox.put(message)

    def report_now(self) -> None:
        """Do the same without waiting for room; without room, they are reported later."""
        if not self._outbox.full and (message := self._taken()):
            self._outbox.put_now(message)

    def _taken(self) -> pb.StreamDepthResponse | None:
        if self._due is not None:
            self._due.cancel()
            self._due = None
        frame_ids, self._frame_ids = self._frame_ids, []
        for _ in frame_ids:
            self._on_reported()
        dropped = pb.FramesDropped(frame_ids=frame_ids)
        return pb.StreamDepthResponse(frames_dropped=dropped) if frame_ids else None
