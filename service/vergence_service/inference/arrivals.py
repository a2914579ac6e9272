"""When the next live frame is due: the gaps that other work may fill without being in the way."""

from dataclasses import dataclass

# A step cannot be interrupted, so one that would still run when a live frame comes is held back.
# Of the interval between a stream's frames, how much later than expected the next may be.
_LATE = 0.5
# Streams with longer intervals than this have no rhythm that is worth waiting for.
_LONGEST_S = 1.0
_SMOOTHING = 0.2


@dataclass(slots=True)
class _Cadence:
    last_s: float  # when its last frame came
    answered_s: float  # when that was answered; until then no other can come
    interval_s: float | None = None  # None: only one frame has come


@dataclass(frozen=True, slots=True)
class ExpectedFrame:
    """A live frame that is expected."""

    at_s: float
    until_s: float  # after which it is not waited for


class ArrivalPredictor:
    """Learns from the arrivals of live steps when the next ones come, stream by stream."""

    def __init__(self) -> None:
        self._beats: dict[str, _Cadence] = {}

    def arrived(self, stream_id: str, now_s: float) -> None:
        beat = self._beats.get(stream_id)
        interval_s = 0.0 if beat is None else now_s - beat.last_s
        if beat is None or interval_s > _LONGEST_S:
            self._beats[stream_id] = _Cadence(now_s, now_s)
            return
        known_s = beat.interval_s or interval_s
        beat.interval_s = known_s + _SMOOTHING * (interval_s - known_s)
        beat.last_s = now_s

    def answered(self, stream_id: str, now_s: float) -> None:
        if stream_id in self._beats:
            self._beats[stream_id].answered_s = now_s

    def next_expected(self, now_s: float) -> ExpectedFrame | None:
        """The live frame that is expected first; None if none is, or none has a rhythm."""
        found: ExpectedFrame | None = None
        for stream_id, beat in list(self._beats.items()):
            if now_s - beat.last_s > _LONGEST_S * (1 + _LATE):
                del self._beats[stream_id]
            elif beat.interval_s:
                at_s = beat.last_s + beat.interval_s
                until_s = max(at_s, beat.answered_s) + _LATE * beat.interval_s
                if now_s < until_s and (found is None or at_s < found.at_s):
                    found = ExpectedFrame(at_s, until_s)
        return found
