"""Those who look at a stream: each waits for its next frame, and nothing is kept for them."""

import asyncio
from collections import defaultdict

from vergence_service.streams.conversion import SteppedFrame


class Viewers:
    """Hands the next frame of a stream to those who wait for it."""

    def __init__(self) -> None:
        self._waiting: defaultdict[str, set[asyncio.Future[SteppedFrame]]] = defaultdict(set)

    @property
    def count(self) -> int:
        """Return how many wait."""
        return sum(map(len, self._waiting.values()))

    async def next_frame(self, key: str) -> SteppedFrame:
        """Wait for the next step of the stream of this key."""
        frame: asyncio.Future[SteppedFrame] = asyncio.get_running_loop().create_future()
        self._waiting[key].add(frame)
        try:
            return await frame
        finally:
            self._waiting[key].discard(frame)
            if not self._waiting[key]:
                del self._waiting[key]

    def show(self, frame: SteppedFrame) -> None:
        """Hand out a frame that was just stepped."""
        for waiting in self._waiting.get(frame.stream.key, ()):
            if not waiting.done():
                waiting.set_result(frame)
