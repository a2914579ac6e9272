"""What a session hands out: results, the count of what did not become one, and events."""

from dataclasses import dataclass, field, fields
from enum import StrEnum

from vergence_proto.types import DisparityMap


@dataclass(frozen=True, slots=True)
class Drops:
    """Frames of a session that were submitted and never became a result, by where they ended.

    With every frame answered, ``submitted = results + errors raised + drops.total``.
    """

    at_source: int = 0  # submitted while as many as the credit allows were unanswered; never sent
    displaced: int = 0  # a newer frame took their place in the server, or on a full network
    stale: int = 0  # older than their max_age_s when their turn came
    unread: int = 0  # their results came, and newer ones, before anybody read them
    lost: int = 0  # unanswered when the connection broke

    @property
    def total(self) -> int:
        return self.at_source + self.displaced + self.stale + self.unread + self.lost


@dataclass(frozen=True, slots=True, eq=False)
class DepthResult(DisparityMap):
    """A disparity map, and how it came.

    Pixels are those of the rectified left image (``rig``); poses are in the session's axes.
    """

    age_s: float = 0.0  # from capture_ns to the arrival of this result
    drops: Drops = field(default_factory=Drops)  # of the session, up to here

    @classmethod
    def of(cls, disparity_map: DisparityMap, *, age_s: float, drops: Drops) -> "DepthResult":
        values = {each.name: getattr(disparity_map, each.name) for each in fields(DisparityMap)}
        return cls(**values, age_s=age_s, drops=drops)


class EventKind(StrEnum):
    DISCONNECTED = "disconnected"  # the connection broke; the session is trying to resume
    RESUMED = "resumed"  # it is back, and the stream's state was kept
    DRAINING = "draining"  # the server is shutting down
    EXPIRING = "expiring"  # no frame has come for long; the server will forget the stream


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """Something that happened to a session and not to one of its frames."""

    kind: EventKind
    message: str
    in_s: float = 0.0  # how long until it happens; 0: it has happened
