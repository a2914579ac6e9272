"""Results of a session, the count of frames without a result, and events."""

from dataclasses import dataclass, field
from enum import StrEnum

from vergence_proto.geometry import Axes
from vergence_proto.types import DisparityMap


@dataclass(frozen=True, slots=True)
class Drops:
    """The number of submitted frames that never became a result, by where they ended.

    Once every frame is answered, ``submitted == results + errors raised + drops.total``.
    """

    at_source: int = 0
    """Not sent: as many frames as the credit allows were unanswered, or the connection was down."""
    displaced: int = 0
    """Displaced by a newer frame in the server, or on a full network."""
    stale: int = 0
    """Older than their ``max_age_s`` when their turn came."""
    unread: int = 0
    """Results that arrived and were displaced by newer ones before the program read them."""
    lost: int = 0
    """Unanswered when the connection broke."""

    @property
    def total(self) -> int:
        """The sum of all drops."""
        return self.at_source + self.displaced + self.stale + self.unread + self.lost


@dataclass(frozen=True, slots=True, eq=False)
class DepthResult(DisparityMap):
    """A disparity map with its age and the session's drops.

    Pixels are those of the rectified left image (``rig``). Poses are in the session's axes.
    """

    age_s: float = 0.0
    """Seconds from ``capture_ns`` to the arrival of this result."""
    drops: Drops = field(default_factory=Drops)
    """The drops of the session until this result."""
    axes: Axes = Axes.OPENCV
    """The axes of ``world_from_left``: those of the session."""


class EventKind(StrEnum):
    """The kind of a :class:`SessionEvent`."""

    DISCONNECTED = "disconnected"
    """The connection broke; the session is trying to resume."""
    RESUMED = "resumed"
    """The connection is back, and the stream's state was kept."""
    DRAINING = "draining"
    """The server is shutting down."""
    EXPIRING = "expiring"
    """No frame has come for long; the server will discard the stream."""


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """An event that concerns a whole session and not one of its frames."""

    kind: EventKind
    """The kind of event."""
    message: str
    """A sentence for a log."""
    in_s: float = 0.0
    """Seconds until it happens; 0: it has happened."""
