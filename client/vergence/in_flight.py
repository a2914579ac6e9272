"""The ledger of a session's frames: which are unanswered, and what became of the others."""

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, replace

from vergence.results import DepthResult, Drops


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A frame that was sent and not answered yet."""

    frame_id: int
    request: bytes  # as it was sent
    answer: asyncio.Future[DepthResult] | None  # None: live, nobody waits for this very frame

    def fail(self, error: Exception) -> None:
        if self.answer is not None and not self.answer.done():
            self.answer.set_exception(error)


class Flights:
    """Frames in the air, in the order they were sent, never more than the server's credit."""

    def __init__(self) -> None:
        self.credit = 1
        self.drops = Drops()
        self._by_id: dict[int, Flight] = {}
        self._landed = asyncio.Event()

    @property
    def has_room(self) -> bool:
        return len(self._by_id) < self.credit

    async def room(self) -> None:
        """Wait until the credit allows one more."""
        while not self.has_room:
            self._landed.clear()
            await self._landed.wait()

    def launch(self, flight: Flight) -> None:
        self._by_id[flight.frame_id] = flight

    def land(self, frame_id: int) -> Flight | None:
        """The flight that was answered; None for one that has been given up since."""
        flight = self._by_id.pop(frame_id, None)
        self._landed.set()
        return flight

    def abandon(self, flights: Iterable[Flight], error: Exception) -> None:
        """Give up flights that will not be answered."""
        for flight in flights:
            self.land(flight.frame_id)
            if flight.answer is None:
                self.count(lost=1)
            flight.fail(error)

    def in_order(self) -> list[Flight]:
        return list(self._by_id.values())

    def count(self, **dropped: int) -> None:
        """Add to the drops, by their field names."""
        self.drops = replace(
            self.drops, **{name: getattr(self.drops, name) + n for name, n in dropped.items()}
        )
