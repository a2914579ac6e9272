"""One stereo stream from the client's side: frames in, depth out."""

import asyncio
import warnings
from collections.abc import Callable, Sequence
from typing import Self

from vergence.connection import RESET
from vergence.errors import NotOpen, WrongDelivery
from vergence.image_format import CameraImage, frame_request, sent_image
from vergence.in_flight import FrameInFlight
from vergence.results import DepthResult, NotSent, SessionState
from vergence.session_facts import SessionFacts, SessionParts, SessionSetup
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.opencv import load_opencv
from vergence_proto.types import Delivery, ImageEncoding, PoseSample, StereoFrame

WorldFromLeft = Pose | PoseSample | Matrix | Sequence[Sequence[float]] | None


class DepthSession(SessionFacts):
    """One stereo stream. :meth:`vergence.DepthClient.open_session` makes it; use ``async with``.

    There are two ways to use a session. Request and response, where no frame is dropped::

        result = await session.step(left, right, world_from_left)

    Live, where the newest frame wins: one task submits frames at camera rate, another reads::

        session.submit(left, right, world_from_left)

        async for result in session:
            print(result.depth_m.shape, result.age_s)

    Images are uint8, grey [H, W] or RGB [H, W, 3], and have the size of the rig; other forms that
    cameras have are listed at :meth:`submit`. They are copied before the method returns. A pose
    maps left-camera to world coordinates at mid-exposure, in the session's axes and metres; a
    matrix is [3, 4] or [4, 4]. A frame without a pose starts the stream's memory again if earlier
    frames had poses.

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
        super().__init__(SessionParts.of(setup))
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
        if self._parts.responses.opened is not None:
            raise NotOpen("this session was opened before; make a new one with open_session()")
        link = self._parts.setup.link
        if link.images.encoding is not ImageEncoding.RAW or link.map_step > 1:
            self._parts.setup.threads.submit(load_opencv)  # the first frame does not wait for it
        await self._parts.connection.open()
        self._left_open = True
        self._next_id = self._parts.opened().last_frame_id + 1
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """End the stream; the server frees its state."""
        self._left_open = False
        await self._parts.connection.close()
        if self._parts.responses.recording is not None:
            await asyncio.to_thread(self._parts.responses.recording.close)

    def __del__(self) -> None:
        """Warn if nobody has left the ``async with`` (or ``with``) of this session."""
        if self._left_open:
            warnings.warn(
                f"session {self.stream_id!r} was not closed; use it inside async with, or with",
                ResourceWarning,
                stacklevel=2,
                source=self,
            )

    def submit(
        self,
        left: CameraImage,
        right: CameraImage,
        world_from_left: WorldFromLeft = None,
        *,
        capture_ns: int | None = None,
        max_age_s: float | None = None,
    ) -> int | NotSent:
        """Send a live frame without waiting; its result comes by iteration.

        Parameters
        ----------
        left, right
            uint8 [H, W] grey, [H, W, 3] RGB, [H, W, 4] RGBA or [H * 3/2, W] NV12, of the rig's
            size; or the bytes of a JPEG or PNG file, which travel as they are.
        world_from_left
            The left camera's pose at mid-exposure; None: interpolated, if poses were given to
            :meth:`track`, else not known.
        capture_ns
            ``time.monotonic_ns()`` at mid-exposure, or the time of the session's ``clock``;
            default: now. Another clock in nanoseconds will do; then the ages of results are NaN.
        max_age_s
            A frame that waits in the server for longer is dropped (``drops.stale``).

        Returns
        -------
        int | NotSent
            The frame's id, from 1; or the reason why the frame was dropped here, which is false.

        Raises
        ------
        BadImage
            An image has another type or shape, or is a damaged file.
        BadPose
            The pose is not finite, or its rotation is not orthonormal with determinant +1; or the
            frame is outside the tracked poses.
        BadShape
            ``capture_ns`` is no whole number of 64 bits, or impossible on the session's ``clock``.
        WrongDelivery
            The session's delivery is EVERY, which must not drop frames; use :meth:`step`.
        NotOpen
            The session is not open, or has ended.
        DepthError
            The error that ended the stream, such as Superseded.
        """
        self._parts.opened()
        if self._parts.setup.delivery is Delivery.EVERY:
            raise WrongDelivery("submit() may drop frames and this session is lossless: use step()")
        self._check_open()
        if self._parts.connection.state is not SessionState.LIVE:
            self._parts.in_flight.count(offline=1)
            return NotSent.OFFLINE
        if not self._parts.in_flight.has_room:
            self._parts.in_flight.count(at_source=1)
            return NotSent.CREDIT
        refusal = self._parts.link.refusal(len(self._parts.in_flight))
        if refusal is not None:
            paced = refusal is NotSent.PACED
            self._parts.in_flight.count(**{"paced" if paced else "at_source": 1})
            return refusal
        request = self._request(left, right, world_from_left, capture_ns, max_age_s)
        return self._send(request, answer=None)

    async def step(
        self,
        left: CameraImage,
        right: CameraImage,
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
            An image has another type or shape, or is a damaged file.
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
        self._parts.opened()
        answer: asyncio.Future[DepthResult] = asyncio.get_running_loop().create_future()
        async with self._turn:
            await self._parts.in_flight.wait_for_room()
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
        self._parts.responses.reset_after = self._next_id - 1
        self._parts.connection.send(RESET)

    def end(self) -> None:
        """Announce that no frame follows; iteration stops after the last answer.

        Leaving the ``with`` block does this too. A second call does nothing.

        Raises
        ------
        NotOpen
            The session was never open.
        """
        self._parts.opened()
        self._parts.connection.end()

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
        self._parts.opened()
        return await self._parts.responses.next()

    def _check_open(self) -> None:
        self._parts.opened()
        if self._parts.responses.error is not None:
            raise self._parts.responses.error
        if self._parts.connection.ending:
            raise NotOpen("the session has ended; open a new one with client.open_session()")

    def _request(
        self,
        left: CameraImage,
        right: CameraImage,
        world_from_left: WorldFromLeft,
        capture_ns: int | None,
        max_age_s: float | None,
    ) -> bytes | Callable[[], bytes]:
        if world_from_left is not None and not isinstance(world_from_left, (Pose, PoseSample)):
            world_from_left = Pose.from_matrix(world_from_left)
        if isinstance(world_from_left, Pose):
            world_from_left = PoseSample(world_from_left)
        setup = self._parts.setup
        capture_ns = setup.clock.checked_ns(capture_ns)
        if world_from_left is None and setup.poses.in_use:
            world_from_left = setup.poses.at(capture_ns)
        camera, link = setup.opening.rig.left, self._parts.link
        size = (camera.width, camera.height)
        frame = StereoFrame(
            self._next_id,
            capture_ns,
            sent_image(left, size),
            sent_image(right, size),
            world_from_left,
        )
        return frame_request(
            frame,
            link.images,
            size=size,
            map_step=link.map_step,
            max_age_s=max_age_s,
        )

    def _send(
        self,
        request: bytes | Callable[[], bytes],
        answer: asyncio.Future[DepthResult] | None,
    ) -> int:
        frame_id, self._next_id = self._next_id, self._next_id + 1
        reset_before = self._parts.responses.reset_after == frame_id - 1
        frame = FrameInFlight(frame_id, request, answer, reset_before)
        self._parts.in_flight.add(frame)
        self._parts.connection.send(self._parts.responses.request_of(frame))
        return frame_id
