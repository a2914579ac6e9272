"""One stereo stream from the client's side: frames in, depth out."""

import asyncio
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vergence.attaching import RecoveryRules
from vergence.capture_clock import CaptureClock
from vergence.connection import RESET, StreamConnection
from vergence.errors import NotOpen, WrongDelivery
from vergence.in_flight import FrameInFlight, FramesInFlight
from vergence.info import ModelInfo
from vergence.info_codec import model_info_from_proto
from vergence.reprojection import DepthView, Fill, View
from vergence.responses import ResponseRouter
from vergence.results import DepthResult, Drops, NotSent, SessionEvent, SessionState
from vergence.transports.base import Transport
from vergence_proto import codec
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import Delivery, ImageEncoding, PoseSample, StereoFrame
from vergence_proto.v1 import depth_pb2 as pb

WorldFromLeft = Pose | PoseSample | Matrix | Sequence[Sequence[float]] | None


@dataclass(frozen=True, slots=True, eq=False)
class SessionSetup:
    """The choices of :meth:`vergence.DepthClient.open_session`, which alone makes sessions."""

    transport: Transport
    opening: pb.OpenStream
    delivery: Delivery
    encoding: ImageEncoding
    jpeg_quality: int
    on_event: Callable[[SessionEvent], None] | None
    rules: RecoveryRules


class DepthSession:
    """One stereo stream. :meth:`vergence.DepthClient.open_session` makes it; use ``async with``.

    There are two ways to use a session. Request and response, where no frame is dropped::

        result = await session.step(left, right, world_from_left)

    Live, where the newest frame wins: one task submits frames at camera rate, another reads::

        session.submit(left, right, world_from_left)

        async for result in session:
            print(result.depth_m.shape, result.age_s)

    Images are uint8, grey [H, W] or RGB [H, W, 3], and have the size of the rig; they are copied
    before the method returns. A pose maps left-camera to world coordinates at mid-exposure, in the
    session's axes and metres; a matrix is [3, 4] or [4, 4]. A frame without a pose starts the
    stream's memory again if earlier frames had poses.

    Call the methods in the thread of the event loop. A camera with callbacks in another thread
    uses ``loop.call_soon_threadsafe(session.submit, left, right, world_from_left)``.

    If the connection breaks or falls silent, the session makes another one and resumes the stream:
    the next result's origin is RESUMED. If the server does not have the stream any more, the
    session goes on with a new one, whose first result is a cold start. Frame ids go on in both
    cases, ``on_event`` reports them, and :attr:`state` shows the connection.

    Every method but ``__aenter__`` raises :class:`NotOpen` before ``async with``. A session that is
    forgotten while it is open gives a ResourceWarning, as an open file does; its stream stays open
    until the client is closed.
    """

    _left_open = False

    def __init__(self, setup: SessionSetup, /) -> None:
        self._setup = setup
        self._in_flight = FramesInFlight()
        self._responses = ResponseRouter(self._in_flight, codec.axes_from_proto(setup.opening.axes))
        self._connection = StreamConnection(
            setup.transport, setup.opening, self._responses, setup.on_event, setup.rules
        )
        self._clock = CaptureClock(live=setup.delivery is Delivery.NEWEST)
        self._turn = asyncio.Lock()
        self._next_id = 1

    async def __aenter__(self) -> Self:
        """Open the stream, or take it over with the resume token.

        A server that cannot be reached, is not ready or has no room is asked again, for at most
        ``open_timeout_s``; then the latest error is raised.

        Raises
        ------
        BadCalibration
            The server cannot use the rig, or the stream was opened with another one.
        BadShape
            An option is out of range, such as the iterations or the output's denominator.
        ModelChanged
            The server does not run the requested weights.
        StreamExists
            A stream of this id is open, and the resume token is not its own.
        UnknownStream, StreamExpired
            The stream to take over does not exist, or its state was discarded.
        FrameTooLarge
            The rig's images have more pixels than the server accepts.
        StreamLimit, StateMemory, Quota
            The server has no room for another stream.
        Draining, NotReady
            The server is shutting down, or is not ready yet.
        ConnectionLost
            The server cannot be reached, or does not answer.
        NotOpen
            The session was open before; a session opens once.
        """
        if self._responses.opened is not None:
            raise NotOpen("this session was opened before; make a new one with open_session()")
        await self._connection.open()
        self._left_open = True
        self._next_id = self._opened().last_frame_id + 1
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """End the stream; the server frees its state."""
        self._left_open = False
        await self._connection.close()

    def __del__(self) -> None:
        """Warn if nobody has left the ``async with`` (or ``with``) of this session."""
        if self._left_open:
            warnings.warn(
                f"session {self.stream_id!r} was not closed; use it inside async with, or with",
                ResourceWarning,
                stacklevel=2,
                source=self,
            )

    @property
    def stream_id(self) -> str:
        """The id of the stream on the server."""
        return self._setup.opening.stream_id

    @property
    def resume_token(self) -> bytes:
        """The secret with which another session can take this stream over, by its stream id."""
        return self._opened().resume_token

    @property
    def rig(self) -> RectifiedRig:
        """The rig of every result: the one of ``open_session``, or its rectification."""
        self._opened()
        return self._responses.rig

    @property
    def model(self) -> ModelInfo:
        """The model that steps this stream."""
        return model_info_from_proto(self._opened().model)

    @property
    def credit(self) -> int:
        """The number of frames that may be unanswered at once."""
        self._opened()
        return self._in_flight.credit

    @property
    def drops(self) -> Drops:
        """The frames that never became a result, until now."""
        return self._in_flight.drops

    @property
    def round_trip_s(self) -> float | None:
        """Network time in seconds, there and back, of the latest ping; None before the first."""
        return self._connection.round_trip_s

    @property
    def state(self) -> SessionState:
        """The state of the connection; silence shows after 1 s, or three round trips."""
        self._opened()
        return self._connection.state

    @property
    def latest(self) -> DepthResult | None:
        """The newest result so far; None before the first. Any thread may read it, at any time."""
        return self._responses.recent.latest

    def depth_at(
        self,
        world_from_view: Pose | PoseSample | Matrix,
        view: View | None = None,
        *,
        at_ns: int | None = None,
        fill: Fill = "far",
        max_age_s: float = 0.5,
    ) -> DepthView | None:
        """Show the newest result from another pose, such as an eye's at display time.

        Any thread may call it; it never waits for the network, and takes a few milliseconds. An
        earlier result fills what the newest one does not see; see :func:`vergence.reproject`.

        Parameters
        ----------
        world_from_view
            The pose to see from, in the session's axes and metres; a matrix is [3, 4] or [4, 4].
        view
            The camera to see with; default: the rectified left camera.
        at_ns
            The time to show, on the clock of ``capture_ns``; default: now.
        fill
            What to give pixels that no result saw: ``"far"`` or ``"none"``.
        max_age_s
            The greatest age of the newest result, in seconds.

        Returns
        -------
        DepthView | None
            None if there is no result of at most that age.

        Raises
        ------
        BadPose
            The pose is not finite or no rigid transform, or the frames were sent without poses.
        """
        if isinstance(world_from_view, np.ndarray):
            world_from_view = Pose.from_matrix(world_from_view)
        elif isinstance(world_from_view, PoseSample):
            world_from_view = world_from_view.world_from_left
        return self._responses.recent.depth_at(
            world_from_view, view, at_ns=at_ns, fill=fill, max_age_s=max_age_s
        )

    def submit(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft = None,
        *,
        capture_ns: int | None = None,
        max_age_s: float | None = None,
    ) -> int | NotSent:
        """Send a live frame without waiting; its result comes by iteration.

        Parameters
        ----------
        left, right
            uint8 [H, W] grey or [H, W, 3] RGB, of the rig's size.
        world_from_left
            The left camera's pose at mid-exposure; None: not known.
        capture_ns
            ``time.monotonic_ns()`` at mid-exposure; default: now. Another clock in nanoseconds
            will do; then the ages of results are NaN.
        max_age_s
            A frame that waits in the server for longer is dropped (``drops.stale``).

        Returns
        -------
        int | NotSent
            The frame's id, from 1; or the reason why the frame was dropped here, which is false.

        Raises
        ------
        BadImage
            An image is not uint8, or has another shape than those above.
        BadPose
            The pose is not finite, or its rotation is not orthonormal with determinant +1.
        BadShape
            ``capture_ns`` is no whole number of 64 bits.
        WrongDelivery
            The session's delivery is EVERY, which must not drop frames; use :meth:`step`.
        NotOpen
            The session is not open, or has ended.
        DepthError
            The error that ended the stream, such as Superseded.
        """
        self._opened()
        if self._setup.delivery is Delivery.EVERY:
            raise WrongDelivery("submit() may drop frames and this session is lossless: use step()")
        self._check_open()
        if self._connection.state is not SessionState.LIVE:
            self._in_flight.count(offline=1)
            return NotSent.OFFLINE
        if not self._in_flight.has_room:
            self._in_flight.count(at_source=1)
            return NotSent.CREDIT
        request = self._request(left, right, world_from_left, capture_ns, max_age_s)
        return self._send(request, answer=None)

    async def step(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft = None,
        *,
        capture_ns: int | None = None,
    ) -> DepthResult:
        """Send a frame and wait for its result; calls that overlap are sent in order.

        Overlap as many calls as :attr:`credit` to keep the server busy while frames travel.
        Parameters are those of :meth:`submit`.

        Raises
        ------
        BadImage
            An image is not uint8, or has another shape than [H, W] or [H, W, 3].
        BadPose
            The pose is not finite, or its rotation is not orthonormal with determinant +1.
        BadShape
            The images do not have the rig's size, or ``capture_ns`` is no whole number.
        FrameTooLarge
            The frame has more bytes than the server accepts.
        FrameStale
            Delivery is NEWEST, and a newer frame displaced this one.
        ModelFailed, NonFinite
            The model failed on this frame; the stream continues.
        ConnectionLost
            The connection broke after the server took the frame.
        NotOpen
            The session is not open, or has ended.
        DepthError
            The error that ended the stream, such as Superseded.
        """
        self._opened()
        answer: asyncio.Future[DepthResult] = asyncio.get_running_loop().create_future()
        async with self._turn:
            await self._in_flight.wait_for_room()
            self._check_open()
            request = self._request(left, right, world_from_left, capture_ns, max_age_s=None)
            self._send(request, answer)
        return await answer

    def reset(self) -> None:
        """Discard the stream's memory: the next frame is a cold start, as after a cut in a film.

        Raises
        ------
        NotOpen
            The session is not open, or has ended.
        DepthError
            The error that ended the stream.
        """
        self._check_open()
        self._responses.reset_after = self._next_id - 1
        self._connection.send(RESET)

    def end(self) -> None:
        """Announce that no frame follows; iteration stops after the last answer.

        Leaving ``async with`` does this too. A second call does nothing.

        Raises
        ------
        NotOpen
            The session was never open.
        """
        self._opened()
        self._connection.end()

    def __aiter__(self) -> Self:
        """Iterate over the results of submitted frames."""
        return self

    async def __anext__(self) -> DepthResult:
        """Wait for the next result of a submitted frame; a slow reader gets the newest ones.

        Raises
        ------
        ModelFailed, NonFinite, BadShape, FrameTooLarge
            A submitted frame failed. The stream continues: iterate again.
        Superseded, UnknownStream
            Another session has taken the stream over, or closed it.
        StreamExpired, UnknownStream, ModelChanged, Draining, ConnectionLost
            The server does not have the stream any more, and ``on_lost`` is ``"raise"``. With
            ``"restart"``, ModelChanged is raised if ``weights_sha256`` was given.
        Quota, StreamLimit, StateMemory
            The server has had no room for the stream for ``open_timeout_s``.
        NotOpen
            The session was never open.
        """
        self._opened()
        return await self._responses.next()

    def _opened(self) -> pb.StreamOpened:
        if self._responses.opened is None:
            raise NotOpen(
                "the session is not open; write: async with client.open_session(rig) as session"
            )
        return self._responses.opened

    def _check_open(self) -> None:
        self._opened()
        if self._responses.error is not None:
            raise self._responses.error
        if self._connection.ending:
            raise NotOpen("the session has ended; open a new one with client.open_session()")

    def _request(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft,
        capture_ns: int | None,
        max_age_s: float | None,
    ) -> bytes:
        if world_from_left is not None and not isinstance(world_from_left, (Pose, PoseSample)):
            world_from_left = Pose.from_matrix(world_from_left)
        if isinstance(world_from_left, Pose):
            world_from_left = PoseSample(world_from_left)
        capture_ns = self._clock.checked_ns(capture_ns)
        frame = StereoFrame(self._next_id, capture_ns, left, right, world_from_left)
        return codec.frame_to_request(
            frame,
            encoding=self._setup.encoding,
            jpeg_quality=self._setup.jpeg_quality,
            max_age_s=max_age_s,
        )

    def _send(self, request: bytes, answer: asyncio.Future[DepthResult] | None) -> int:
        frame_id, self._next_id = self._next_id, self._next_id + 1
        self._in_flight.add(FrameInFlight(frame_id, request, answer))
        self._connection.send(request)
        return frame_id
