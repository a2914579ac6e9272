"""A span for every frame, and one for each of its stages."""

from typing import Protocol

from vergence_service.streams.conversion import SteppedFrame


class FrameTraces(Protocol):
    """Receives every stepped frame. It must neither block nor raise."""

    def add(self, frame: SteppedFrame, *, age_s: float) -> None:
        """Record a frame that was just stepped, ``age_s`` after it arrived."""
        ...
