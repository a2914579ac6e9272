"""A stream: the configuration and the recurrent state of one client's sequence of frames."""

import asyncio
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from vergence_proto.errors import DepthError, ErrorCode, FrameOutOfOrder
from vergence_proto.geometry import Axes
from vergence_proto.types import Delivery, Origin, OutputFormat, StereoRig
from vergence_service.access.principals import LOCAL, Principal
from vergence_service.inference.model import RecurrentState, StereoView
from vergence_service.process.memory import MemoryHold
from vergence_service.snapshots.saver import StreamSaver
from vergence_service.streams.continuity import ContinuityLimits, break_between
from vergence_service.streams.rectify import Rectifier


class NoticeKind(Enum):
    DRAINING = "draining"
    EXPIRING = "expiring"


@dataclass(frozen=True, slots=True)
class Notice:
    """An announcement of something that will soon happen to a stream."""

    kind: NoticeKind
    message: str
    in_s: float  # time until it happens


@dataclass(frozen=True, slots=True)
class TraceParent:
    """A span of a client, in hexadecimal digits (W3C Trace Context)."""

    trace_id: str  # 32
    span_id: str  # 16
    flags: str  # 2


class Attachment(Protocol):
    """The connection that uses a stream. Its methods must neither block nor raise."""

    @property
    def transport(self) -> str:
        """Its name: grpc, http or zenoh."""
        ...

    @property
    def trace_parent(self) -> TraceParent | None:
        """The span of the client that opened the connection; None: not known."""
        ...

    @property
    def busy(self) -> bool:
        """True while a frame of the client waits or is stepped."""
        ...

    @property
    def silent_s(self) -> float:
        """The time since the client last sent anything.

        0 while it waits for an answer, and if it never pings: then silence says nothing.
        """
        ...

    def notify(self, notice: Notice) -> None:
        """Send the notice to the client."""
        ...

    def end(self, error: DepthError) -> None:
        """End the connection with ``error``: the stream does not belong to it any more."""
        ...

    def lose(self, why: str) -> None:
        """End the connection as if it were lost: the client may resume the stream on another."""
        ...

    async def ended(self) -> None:
        """Wait until the connection has ended."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class StreamConfig:
    """The client's choices for a stream."""

    rig: StereoRig
    axes: Axes = Axes.OPENCV
    delivery: Delivery = Delivery.NEWEST
    output: OutputFormat = field(default_factory=OutputFormat)
    iterations: int = 0  # iterations of a warm step; 0: the server's default
    cold_iterations: int = 0  # iterations of a cold step; 0: the server's default
    weights_sha256: str = ""  # weights that the server must run; empty: any weights
    opening_id: bytes = b""  # secret with which the opening may be repeated; empty: none


@dataclass(slots=True, eq=False)
class Stream:
    """One client's sequence: its rig, its recurrent state and the order of its frames."""

    stream_id: str
    client: str  # address whose limit the stream counts towards; empty: none
    resume_token: bytes
    config: StreamConfig
    rectifier: Rectifier
    memory: MemoryHold  # what is reserved for it
    attachment: Attachment | None
    active_s: float  # time of the last frame, attachment or detachment
    state: RecurrentState | None = None
    origin: Origin = Origin.COLD_START  # origin of the next step, if its view continues the state
    last_frame_id: int = 0  # last frame that was stepped
    frames_stepped: int = 0
    frames_dropped: int = 0
    frames_failed: int = 0
    frames_skipped: int = 0  # frames dropped or failed since the last stepped frame
    warned: bool = False  # the client knows that the stream will expire
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    owner: Principal = LOCAL
    trace_parent: TraceParent | None = None
    transport: str = ""  # over which the client is attached
    # For administrators: when the last frames were stepped and how old they were then, in seconds.
    answers: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=512))
    last_origin: Origin | None = None  # of the last step
    last_iterations: int = 0
    failures: Counter[ErrorCode] = field(default_factory=Counter)  # frames, by reason
    model_s: float = 0.0  # time in the model, of all frames
    saver: StreamSaver | None = None  # None: no snapshots are kept

    @property
    def key(self) -> str:
        """Name of the stream that no other open stream has."""
        return key_of(self.owner.name, self.stream_id)

    def check_order(self, frame_id: int) -> None:
        """Raise FrameOutOfOrder unless the frame is newer than the last stepped one."""
        if frame_id <= self.last_frame_id:
            raise FrameOutOfOrder(
                f"expected a frame_id above {self.last_frame_id}, the last stepped frame, "
                f"got {frame_id}"
            )

    def state_before(
        self, view: StereoView, limits: ContinuityLimits
    ) -> tuple[RecurrentState | None, Origin]:
        """Return the state to step ``view`` from, None for a cold start, and the reason."""
        if self.state is None:
            return None, self.origin
        broken = break_between(self.state, view, limits)
        return (None, broken) if broken else (self.state, self.origin)

    def commit(self, frame_id: int, state: RecurrentState, *, frames_skipped: int) -> None:
        """Record that ``frame_id`` was stepped, ``frames_skipped`` frames after the one before."""
        if state.tensors:
            self.state, self.origin = state, Origin.WARM
        # Otherwise the model has no memory, and the next frame is a cold start as well.
        self.last_frame_id = frame_id
        self.frames_stepped += 1
        # Frames that were dropped while this one was in the model count for the next.
        self.frames_skipped -= frames_skipped

    def note_answer(
        self, now_s: float, arrived_s: float, origin: Origin, iterations: int, model_s: float
    ) -> None:
        """Record a step for administrators."""
        self.answers.append((now_s, now_s - arrived_s))
        self.last_origin, self.last_iterations = origin, iterations
        self.model_s += model_s

    def forget(self, reason: Origin) -> None:
        """Discard the state; the next step is cold."""
        self.state = None
        self.origin = reason


def key_of(owner: str, stream_id: str) -> str:
    """Return the name of a stream among those of all principals; neither part has a slash."""
    return f"{owner}/{stream_id}"
