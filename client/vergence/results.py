"""Results of a session, the count of frames without a result, and events."""

from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadPose
from vergence_proto.geometry import Axes
from vergence_proto.types import DisparityMap, ReceivedPlanes


@dataclass(frozen=True, slots=True)
class Drops:
    """The number of submitted frames that never became a result, by where they ended.

    Once every frame is answered, ``submitted == results + errors raised + drops.total``.
    """

    at_source: int = 0
    """Not sent: as many frames as the credit allows were unanswered."""
    paced: int = 0
    """Not sent: the link, or the server, was still busy with earlier frames."""
    offline: int = 0
    """Not sent: the connection was down, or silent."""
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
        source = self.at_source + self.paced + self.offline
        return source + self.displaced + self.stale + self.unread + self.lost


@dataclass(frozen=True, slots=True, eq=False)
class DepthResult(DisparityMap):
    """A disparity map with its age and the session's drops.

    Pixels are those of the rectified left image (``rig``). Poses are in the session's axes.
    """

    age_s: float = 0.0
    """Seconds from ``capture_ns`` to the arrival of this result.

    NaN if ``capture_ns`` is not a time of ``time.monotonic_ns()``, as in a recording.
    """
    drops: Drops = field(default_factory=Drops)
    """The drops of the session until this result."""
    axes: Axes = Axes.OPENCV
    """The axes of ``world_from_left``: those of the session."""
    raw: ReceivedPlanes | None = None
    """The map as it was received: fewer pixels, if the output's ``map_step`` is above 1."""

    def points_m(self, *, world: bool = False) -> NDArray[np.float32]:
        """Return the pixels as points in metres, in the axes of the session.

        Parameters
        ----------
        world
            Return world coordinates; the default is coordinates of the rectified left camera.

        Returns
        -------
        NDArray[np.float32]
            [H, W, 3]; NaN where there is no value.

        Raises
        ------
        BadPose
            World coordinates need a pose, and the result has none.
        """
        if world and self.world_from_left is None:
            raise BadPose(
                f"expected a result with a pose, and frame {self.frame_id} has none; "
                "submit frames with poses to get points of the world"
            )
        depth_m, rig = self.depth_m, self.rig
        height, width = depth_m.shape
        points = np.empty((height, width, 3), np.float32)
        points[..., 0] = (np.arange(width, dtype=np.float32) - rig.cx_left) / rig.fx * depth_m
        points[..., 1] = (np.arange(height, dtype=np.float32) - rig.cy)[:, None] / rig.fy * depth_m
        points[..., 2] = depth_m
        self_from_opencv = np.array(self.axes.value, np.float32).T
        points = points @ self_from_opencv.T
        if world and self.world_from_left is not None:
            points = self.world_from_left.apply(points.astype(np.float64)).astype(np.float32)
        return points


class NotSent(Enum):
    """The reason why :meth:`vergence.DepthSession.submit` did not send a frame. It is false."""

    CREDIT = "credit"
    """As many frames as the credit allows are unanswered, or an answer is late
    (``drops.at_source``)."""
    PACED = "paced"
    """The link, or the server, is still busy with earlier frames (``drops.paced``)."""
    OFFLINE = "offline"
    """The connection is down or silent; see :attr:`vergence.DepthSession.state`."""

    def __bool__(self) -> Literal[False]:
        """Return False: no frame was sent, and so there is no frame id."""
        return False


class SessionState(StrEnum):
    """The state of a session's connection."""

    LIVE = "live"
    """The server answers."""
    STALLED = "stalled"
    """The server has been silent for 1 s, or three round trips; the connection may recover."""
    RECONNECTING = "reconnecting"
    """The connection is lost, and the session is making another one."""
    ENDED = "ended"
    """The session has ended."""


class EventKind(StrEnum):
    """The kind of a :class:`SessionEvent`."""

    STALLED = "stalled"
    """The server is silent; the session waits, and tries another connection."""
    LIVE = "live"
    """The server answers again on the same connection; nothing was lost."""
    DISCONNECTED = "disconnected"
    """The connection broke; the session is trying to resume."""
    RESUMED = "resumed"
    """Another connection is up, and the stream's state was kept. If the next frame is too far from
    the last one for the server to use that state, ``RESTARTED`` follows with its result."""
    RESTARTED = "restarted"
    """Another connection is up, and the stream's state is lost: the next frame is a cold start, or
    the one whose result has just arrived was."""
    WAITING = "waiting"
    """The server has no room for the stream now; the session tries again."""
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
    """Seconds until it happens, or until the next attempt; 0: it has happened."""
