"""How long a server has been silent, and when that is too long."""

import time
from collections import deque

from vergence_proto.v1 import depth_pb2 as pb

# With a ping every quarter of a second, silence is reported within a second, or three round trips.
_SILENCE_S = 0.8
_ROUND_TRIPS = 2.5
_ROUND_TRIPS_KEPT = 16
# A slow link may still be busy with what was sent, so a replacement waits for at least this rate.
_SLOWEST_BYTES_PER_S = 500_000
# Replacing a connection to a server that is only slow makes it slower: the next time takes longer.
_MAX_FACTOR = 8.0
_CALM_S = 30.0
_ACTIVE_PING_S, _IDLE_PING_S, _ACTIVE_FOR_S = 0.25, 0.5, 5.0
# A process that did not run for this long cannot know whether the server was silent.
_STOPPED_S = 0.5


class Silence:
    """Keeps the times of a connection's pings, answers and bytes. Times are of time.monotonic()."""

    def __init__(self) -> None:
        self.round_trip_s: float | None = None
        self._round_trips_s: deque[float] = deque(maxlen=_ROUND_TRIPS_KEPT)
        self._factor = 1.0
        self._replaced_s = 0.0
        self._active_s = 0.0
        self.begin()

    def begin(self) -> None:
        """Start with a new connection."""
        self._heard_s = self._looked_s = time.monotonic()
        self._pinged_s = 0.0
        self._sent_bytes = 0
        self._arrived_bytes = 0
        self._sent_before: dict[int, int] = {}  # bytes sent before each ping without a pong

    @property
    def silent_s(self) -> float:
        """Return the time since the last message from the server."""
        return time.monotonic() - self._heard_s

    @property
    def too_long(self) -> bool:
        """Return True if the silence is to be reported."""
        now_s = time.monotonic()
        if now_s - self._looked_s > _STOPPED_S:
            self._heard_s = now_s
        self._looked_s = now_s
        return now_s - self._heard_s > self._patience_s

    @property
    def hopeless(self) -> bool:
        """Return True if the silence lasts so long that another connection should be tried."""
        unanswered = self._sent_bytes - self._arrived_bytes
        wait_s = self._factor * self._patience_s + unanswered / _SLOWEST_BYTES_PER_S
        return self.too_long and self.silent_s > wait_s

    @property
    def ping_due(self) -> bool:
        """Return True if the next frame should take a ping along."""
        return time.monotonic() - self._pinged_s >= self.ping_interval_s / 2

    @property
    def ping_late(self) -> bool:
        """Return True if a ping must be sent without a frame."""
        return time.monotonic() - self._pinged_s >= 0.9 * self.ping_interval_s

    @property
    def ping_interval_s(self) -> float:
        """Return the time between two pings: a session that is not in use needs fewer."""
        active = time.monotonic() - self._active_s < _ACTIVE_FOR_S
        return _ACTIVE_PING_S if active else _IDLE_PING_S

    def replaced(self) -> None:
        """Record that the connection is replaced because of its silence."""
        now_s = time.monotonic()
        calm = now_s - self._replaced_s > _CALM_S
        self._factor = 1.0 if calm else min(2 * self._factor, _MAX_FACTOR)
        self._replaced_s = now_s

    def pinged(self, ping: pb.Ping) -> None:
        """Record a ping that is sent now."""
        self._pinged_s = time.monotonic()
        self._sent_before[ping.client_ns] = self._sent_bytes

    def active(self) -> None:
        """Record that the session is in use."""
        self._active_s = time.monotonic()

    def sent(self, request: bytes) -> None:
        """Record a request that is sent now."""
        self._sent_bytes += len(request)

    def heard(self, response: pb.StreamDepthResponse) -> None:
        """Record a message from the server."""
        self._heard_s = time.monotonic()
        if not response.HasField("pong"):
            return
        pong = response.pong
        self.round_trip_s = (time.monotonic_ns() - pong.client_ns - pong.server_hold_ns) * 1e-9
        self._round_trips_s.append(self.round_trip_s)
        self._arrived_bytes = max(self._arrived_bytes, self._sent_before.get(pong.client_ns, 0))
        for client_ns in [each for each in self._sent_before if each <= pong.client_ns]:
            del self._sent_before[client_ns]

    @property
    def _patience_s(self) -> float:
        return max(_SILENCE_S, _ROUND_TRIPS * max(self._round_trips_s, default=0.0))
