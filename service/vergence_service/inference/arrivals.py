"""Predict the next frame of live streams, so that other work can run in the gaps."""

from dataclasses import dataclass

# A step cannot be interrupted. A step that would still run when a live frame arrives has to wait.
# The next frame may arrive late by this share of the interval between a stream's frames.
_LATE = 0.5
# Streams with longer intervals than this are not predicted: waiting for them would cost too much.
_LONGEST_S = 1.0
_SMOOTHING = 0.2


@dataclass(slots=True)
class _Cadence:
    """The times of one stream's frames."""

    last_s: float  # arrival of the last frame
    answered_s: float  # time of the last answer; the client sends no frame before it
    interval_s: float | None = None  # smoothed interval; None after the first frame


@dataclass(frozen=True, slots=True)
class ExpectedFrame:
    """A live frame that will probably arrive."""

    at_s: float  # expected arrival
    until_s: float  # stop waiting for the frame at this time


class ArrivalPredictor:
    """Learns the interval between frames of each live stream and predicts the next arrival."""

    def __init__(self) -> None:
        self._cadences: dict[str, _Cadence] = {}

    def __len__(self) -> int:
        return len(self._cadences)

    def arrived(self, stream_id: str, now_s: float) -> None:
        """Record that a frame of the stream arrived."""
        cadence = self._cadences.get(stream_id)
        interval_s = 0.0 if cadence is None else now_s - cadence.last_s
        if cadence is None or interval_s > _LONGEST_S:
            self._cadences[stream_id] = _Cadence(now_s, now_s)
            return
        known_s = cadence.interval_s or interval_s
        cadence.interval_s = known_s + _SMOOTHING * (interval_s - known_s)
        cadence.last_s = now_s

    def answered(self, stream_id: str, now_s: float) -> None:
        """Record that the last frame of the stream was answered."""
        if stream_id in self._cadences:
            self._cadences[stream_id].answered_s = now_s

    def forget(self, stream_id: str) -> None:
        """Forget a stream, because it is closed."""
        self._cadences.pop(stream_id, None)

    def next_expected(self, now_s: float) -> ExpectedFrame | None:
        """Return the live frame that is expected first, or None if none is expected."""
        found: ExpectedFrame | None = None
        for stream_id, cadence in list(self._cadences.items()):
            if now_s - cadence.last_s > _LONGEST_S * (1 + _LATE):
                del self._cadences[stream_id]
            elif cadence.interval_s:
                at_s = cadence.last_s + cadence.interval_s
                until_s = max(at_s, cadence.answered_s) + _LATE * cadence.interval_s
                if now_s < until_s and (found is None or at_s < found.at_s):
                    found = ExpectedFrame(at_s, until_s)
        return found
