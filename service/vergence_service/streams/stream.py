"""A stream: what one client's sequence of frames needs to be remembered."""

import asyncio
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from vergence_proto.errors import DepthError, FrameOutOfOrder
from vergence_proto.geometry import Axes
from vergence_proto.types import Delivery, Origin, OutputFormat, StereoRig
from vergence_service.inference.model import RecurrentState, StereoView
from vergence_service.streams.continuity import ContinuityLimits, break_between
from vergence_service.streams.rectify import Rectifier


class NoticeKind(Enum):
    DRAINING = "draining"
    EXPIRING = "expiring"


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that will happen to a stream, told before it does."""

    kind: NoticeKind
    message: str
    in_s: float


class Attachment(Protocol):
    """The connection that has a stream. Neither method may block or raise."""

    def notify(self, notice: Notice) -> None: ...

    def end(self, error: DepthError) -> None:
        """The stream is no longer this connection's."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class StreamConfig:
    """How a client wants its stream."""

    rig: StereoRig
    axes: Axes = Axes.OPENCV
    delivery: Delivery = Delivery.NEWEST
    output: OutputFormat = field(default_factory=OutputFormat)
    iterations: int = 0  # of a warm step; 0: the server's default
    cold_iterations: int = 0
    weights_sha256: str = ""  # that all results must come from; empty: whatever the server runs


@dataclass(slots=True, eq=False)
class Stream:
    """One client's sequence: its rig, its recurrent state, its place in the order of frames."""

    stream_id: str
    client: str  # whose share it counts to; empty: nobody's
    resume_token: bytes
    config: StreamConfig
    rectifier: Rectifier
    state_bytes: int  # reserved for it
    attachment: Attachment | None
    active_s: float  # when it last had a frame, or was attached or detached
    state: RecurrentState | None = None
    origin: Origin = Origin.COLD_START  # of the next step, unless its view breaks continuity
    last_frame_id: int = 0  # the last one stepped
    frames_stepped: int = 0
    frames_dropped: int = 0
    frames_failed: int = 0
    frames_skipped: int = 0  # not stepped since the last one that was
    warned: bool = False  # of its expiry
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)

    def check_order(self, frame_id: int) -> None:
        if frame_id <= self.last_frame_id:
            raise FrameOutOfOrder(
                f"expected a frame_id above {self.last_frame_id}, the last one stepped, "
                f"got {frame_id}"
            )

    def state_before(
        self, view: StereoView, limits: ContinuityLimits
    ) -> tuple[RecurrentState | None, Origin]:
        """The state that ``view`` is stepped on, None for a cold start, and why."""
        if self.state is None:
            return None, self.origin
        broken = break_between(self.state, view, limits)
        return (None, broken) if broken else (self.state, self.origin)

    def commit(self, frame_id: int, state: RecurrentState, *, frames_skipped: int) -> None:
        """Frame ``frame_id`` was stepped, ``frames_skipped`` after the one before it."""
        self.state = state
        self.origin = Origin.WARM
        self.last_frame_id = frame_id
        self.frames_stepped += 1
        # Those that were dropped while this one was in the model belong to the next.
        self.frames_skipped -= frames_skipped

    def forget(self, reason: Origin) -> None:
        """The next step starts from nothing."""
        self.state = None
        self.origin = reason
