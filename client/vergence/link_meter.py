"""Measurement of a session's way to the server and back: uplink, downlink, queues and server apart.

The two clocks have an unknown offset, so a time of flight is only ever compared with the times of
flight of pings, which have hardly any bytes.
"""

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from vergence_proto.v1 import depth_pb2 as pb

_FRAMES_KEPT = 12
_PINGS_KEPT = 40
# Pings may wait behind frames, and their times vary. The lower quarter saw the way without a queue.
_UNQUEUED_SHARE = 0.25
# Over HTTP a ping is answered before the frame leaves: then it says nothing about the frame.
_TOGETHER_NS = 2_000_000
_LEAST_SERVICE_NS = 200_000  # a shorter time says nothing about a rate
_S = 1e-9


@dataclass(frozen=True, slots=True)
class LinkTimes:
    """What the frames and pings of the last moments say about each part of the way.

    Rates and times are None before they are known.
    """

    frames: int = 0
    """Answers that the numbers are from."""
    up_bytes_s: float | None = None
    """Bytes per second that the uplink takes."""
    down_bytes_s: float | None = None
    """Bytes per second that the downlink takes."""
    path_round_trip_s: float | None = None
    """Round trip of the path alone: the shortest of the latest pings."""
    up_queue_s: float = 0.0
    """Time that a frame waits in the uplink behind earlier ones."""
    up_queue_growth: float = 0.0
    """Growth of that time: seconds in each second."""
    down_queue_s: float = 0.0
    """Time that a map waits in the downlink behind earlier ones."""
    server_s: float | None = None
    """Time that the server is busy with one frame."""
    frame_bytes: float = 0.0
    """Bytes of a frame of the latest format."""
    map_bytes: float = 0.0
    """Bytes of a map of the latest format."""
    answer_s: float | None = None
    """Time from sending a frame to the arrival of its result."""


@dataclass(frozen=True, slots=True)
class _Sent:
    at_ns: int
    nbytes: int
    ping_ns: int | None  # the client's time of a ping that was sent just before


@dataclass(frozen=True, slots=True)
class _Seen:
    """One frame that went up and came back as a map. Rates in bytes per second."""

    at_ns: int
    up_rate: float
    up_queue_s: float
    down_rate: float
    down_queue_s: float
    server_s: float
    answer_s: float
    frame_bytes: int
    map_bytes: int


class LinkMeter:
    """Collects the times of one connection's frames and pings."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget everything: the connection is a new one."""
        self._sent: dict[int, _Sent] = {}
        self._pings_up_ns: deque[int] = deque(maxlen=_PINGS_KEPT)
        self._pings_down_ns: deque[int] = deque(maxlen=_PINGS_KEPT)
        self._round_trips_ns: deque[int] = deque(maxlen=_PINGS_KEPT)
        self._ping_received_ns: dict[int, int] = {}
        self._seen: deque[_Seen] = deque(maxlen=_FRAMES_KEPT)
        self._last_received_ns = self._last_arrived_ns = -(1 << 62)
        self._times: LinkTimes | None = None  # None: something was recorded since

    def frame_sent(self, frame_id: int, nbytes: int, at_ns: int, *, ping_ns: int | None) -> None:
        """Record a frame whose first byte leaves now; ``ping_ns``: of the ping just before it."""
        self._sent[frame_id] = _Sent(at_ns, nbytes, ping_ns)

    def frame_over(self, frame_id: int) -> None:
        """Forget a frame that has no map."""
        self._sent.pop(frame_id, None)

    def ponged(self, pong: pb.Pong, arrived_ns: int) -> None:
        """Record the answer to a ping."""
        if not pong.received_ns:  # an older server
            return
        self._pings_up_ns.append(pong.received_ns - pong.client_ns)
        self._pings_down_ns.append(arrived_ns - pong.received_ns - pong.server_hold_ns)
        self._round_trips_ns.append(arrived_ns - pong.client_ns - pong.server_hold_ns)
        self._ping_received_ns = {pong.client_ns: pong.received_ns}
        self._times = None

    def answered(self, message: pb.DisparityMap, nbytes: int, arrived_ns: int) -> None:
        """Record a map of ``nbytes`` bytes."""
        sent = self._sent.pop(message.frame_id, None)
        if sent is None or not message.received_ns or not self._pings_up_ns:
            return
        received_ns = message.received_ns
        # In the order of time: its first byte could be at the server, was, and its last byte was.
        free_ns = sent.at_ns + _unqueued(self._pings_up_ns)
        near = sent.ping_ns is not None and sent.at_ns - sent.ping_ns < _TOGETHER_NS
        if near and sent.ping_ns in self._ping_received_ns:
            free_ns = self._ping_received_ns[sent.ping_ns]
        started_ns = max(free_ns, self._last_received_ns)
        answered_ns = received_ns + message.timings.total_us * 1000
        down_free_ns = answered_ns + _unqueued(self._pings_down_ns)
        down_started_ns = max(down_free_ns, self._last_arrived_ns)
        timings = message.timings
        self._seen.append(
            _Seen(
                sent.at_ns,
                _rate(sent.nbytes, received_ns - started_ns),
                (started_ns - free_ns) * _S,
                _rate(nbytes, arrived_ns - down_started_ns),
                (down_started_ns - down_free_ns) * _S,
                (timings.decode_us + timings.model_us) * 1e-6,
                (arrived_ns - sent.at_ns) * _S,
                sent.nbytes,
                nbytes,
            )
        )
        self._last_received_ns, self._last_arrived_ns = received_ns, arrived_ns
        self._times = None

    @property
    def oldest_sent_ns(self) -> int | None:
        """Return when the oldest frame without an answer was sent."""
        return min((each.at_ns for each in self._sent.values()), default=None)

    def times(self) -> LinkTimes:
        """Return what is known now."""
        if self._times is None:
            self._times = self._summed_up()
        return self._times

    def _summed_up(self) -> LinkTimes:
        path_s = min(self._round_trips_ns) * _S if self._round_trips_ns else None
        seen = self._seen
        if not seen:
            return LinkTimes(path_round_trip_s=path_s)
        return LinkTimes(
            frames=len(seen),
            up_bytes_s=median(each.up_rate for each in seen),
            down_bytes_s=median(each.down_rate for each in seen),
            path_round_trip_s=path_s,
            up_queue_s=median(each.up_queue_s for each in list(seen)[-5:]),
            up_queue_growth=_growth(seen),
            down_queue_s=median(each.down_queue_s for each in list(seen)[-5:]),
            server_s=median(each.server_s for each in seen),
            frame_bytes=seen[-1].frame_bytes,
            map_bytes=seen[-1].map_bytes,
            answer_s=median(each.answer_s for each in seen),
        )


def _rate(nbytes: int, service_ns: int) -> float:
    return nbytes / (max(service_ns, _LEAST_SERVICE_NS) * _S)


def _unqueued(flights_ns: deque[int]) -> int:
    ordered = sorted(flights_ns)
    return ordered[math.floor(_UNQUEUED_SHARE * (len(ordered) - 1))]


def _growth(seen: deque[_Seen]) -> float:
    """Return the slope of the uplink's queue over the frames, by least squares."""
    mean_ns = sum(each.at_ns for each in seen) / len(seen)
    mean_s = sum(each.up_queue_s for each in seen) / len(seen)
    offsets_s = [(each.at_ns - mean_ns) * _S for each in seen]
    spread = sum(each * each for each in offsets_s)
    if not spread:
        return 0.0
    pairs = zip(offsets_s, seen, strict=True)
    return sum(offset_s * (each.up_queue_s - mean_s) for offset_s, each in pairs) / spread
