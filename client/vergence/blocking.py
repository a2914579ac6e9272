"""The blocking client, for programs without an event loop: every call waits for its result.

An event loop runs in one background thread, which the client's ``with`` starts and ends.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, Self, TypeVar

from vergence.attaching import OnLost
from vergence.client import DepthClient
from vergence.image_format import CameraImage
from vergence.info import ServerInfo, StreamInfo
from vergence.loop_thread import LoopThread
from vergence.results import DepthResult, NotSent, SessionEvent
from vergence.session import DepthSession, WorldFromLeft
from vergence.session_facts import SessionFacts
from vergence.transports.addresses import DEFAULT_SERVER
from vergence_proto.geometry import Axes, Matrix, Pose, RectifiedRig
from vergence_proto.types import Delivery, ImageEncoding, OutputFormat, StereoRig

Value = TypeVar("Value")


class BlockingSession(SessionFacts):
    """A :class:`DepthSession` whose ``step`` returns and whose iteration is ``for``.

    :meth:`BlockingClient.open_session` makes it; use it inside ``with``. Every method but
    ``__enter__`` raises :class:`vergence.NotOpen` before that.
    """

    def __init__(self, session: DepthSession, loop: LoopThread, /) -> None:
        super().__init__(session._parts)  # noqa: SLF001  the same session, for other callers
        self._session = session
        self._loop = loop

    def __enter__(self) -> Self:
        """Open the stream; errors are those of :meth:`DepthSession.__aenter__`."""
        self._loop.wait(self._session.__aenter__())
        return self

    def __exit__(self, *exc_info: object) -> None:
        """End the stream; the server frees its state."""
        self._loop.wait(self._session.__aexit__(*exc_info))

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
        return self._loop.call(
            lambda: self._session.submit(
                left, right, world_from_left, capture_ns=capture_ns, max_age_s=max_age_s
            )
        )

    def step(
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
        return self._loop.wait(
            self._session.step(left, right, world_from_left, capture_ns=capture_ns)
        )

    def reset(self) -> None:
        """Discard the stream's memory: the next frame is a cold start, as after a cut in a film.

        Raises
        ------
        NotOpen
            The session is not open, or has ended.
        DepthError
            The error that ended the stream.
        """
        self._loop.call(self._session.reset)

    def end(self) -> None:
        """Announce that no frame follows; iteration stops after the last answer.

        Leaving the ``with`` block does this too. A second call does nothing.

        Raises
        ------
        NotOpen
            The session was never open.
        """
        self._loop.call(self._session.end)

    def __iter__(self) -> Self:
        """Iterate over the results of submitted frames."""
        return self

    def __next__(self) -> DepthResult:
        """Wait for the next result; errors are those of :meth:`DepthSession.__anext__`."""
        try:
            return self._loop.wait(self._session.__anext__())
        except StopAsyncIteration:
            raise StopIteration from None


class BlockingClient:
    """A :class:`DepthClient` with its own event loop, for use inside ``with``.

    ``on_event`` callbacks run in the loop's thread. Outside ``with``, every method raises
    :class:`vergence.NotOpen`.

    Parameters
    ----------
    server
        The address of the server, as in :class:`DepthClient`.
    token, ca, cert, key
        The client's credentials, as in :class:`DepthClient`.

    Raises
    ------
    ValueError
        ``server`` is no such address, the package that its scheme needs is not installed, a file
        cannot be read, or the token would be sent over a network in the clear.
    """

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        *,
        token: str | None = None,
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
    ) -> None:
        self._client = DepthClient(server, token=token, ca=ca, cert=cert, key=key)
        self._loop = LoopThread()

    def __enter__(self) -> Self:
        """Start the event loop; this does not connect yet."""
        self._loop.start()
        try:
            self._loop.wait(self._client.__aenter__())
        except BaseException:
            self._loop.stop()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Close the connection and end the event loop."""
        try:
            self._loop.wait(self._client.__aexit__(*exc_info))
        finally:
            self._loop.stop()

    def open_session(
        self,
        rig: StereoRig | RectifiedRig,
        *,
        axes: Axes = Axes.OPENCV,
        delivery: Delivery = Delivery.NEWEST,
        output: OutputFormat | None = None,
        iterations: int = 0,
        cold_iterations: int = 0,
        weights_sha256: str = "",
        encoding: ImageEncoding | None = None,
        jpeg_quality: int | None = None,
        stream_id: str | None = None,
        resume_token: bytes = b"",
        on_event: Callable[[SessionEvent], None] | None = None,
        on_lost: OnLost = "restart",
        link: Literal["auto", "fixed"] | None = None,
        clock: Callable[[], int] | None = None,
        tracked_from_left: Pose | Matrix | None = None,
        pose_offset_s: float = 0.0,
        open_timeout_s: float = 10.0,
    ) -> BlockingSession:
        """Make a session; its ``with`` opens the stream and ends it.

        Parameters
        ----------
        rig
            The cameras as they are; the server rectifies the images if the rig is not rectified.
        axes
            The axis convention of all poses of this session, sent and returned.
        delivery
            NEWEST: live, a newer frame displaces one that waits. EVERY: lossless, ``step`` only.
        output
            The content and precision of results. Default: disparity without confidence and sigma;
            every second pixel, to 1/16 px, for live sessions with a server elsewhere, which the
            client interpolates (:attr:`DepthResult.raw` is as received); else every pixel, to
            1/64 px; compressed without further loss, unless the server is on this machine.
        iterations, cold_iterations
            Refinement iterations of a warm step and of a cold start; 0: the server's defaults.
        weights_sha256
            The weights that results must come from (:attr:`vergence.ModelInfo.weights_sha256`);
            default: any. Without them, a session goes on with a cold start if the server's change.
        encoding
            The format of images on the wire: RAW is exact and large, PNG is exact and slow.
            Default: grey JPEG of quality 80 for live sessions with a server elsewhere, which is 35
            times smaller than raw colour, and as good; else RAW.
        jpeg_quality
            The quality of JPEG, 1 to 100; default: 80 for the grey JPEG, 90 if you ask for JPEG.
        stream_id
            1 to 128 characters of [A-Za-z0-9._-]; default: a random one.
        resume_token
            Take over the open stream of this ``stream_id``; its old session gets Superseded.
        on_event
            Called in the loop's thread with each :class:`SessionEvent`; it must not block.
        on_lost
            What to do when the server does not have the stream any more, because it was restarted
            or has discarded the stream. ``"restart"``: go on with a new stream, whose first result
            is a cold start. ``"raise"``: end the session with the error.
        link
            ``"auto"``: measure the link, send frames at the pace of its slowest part, and choose
            the quality of JPEG, half size and ``map_step`` by what it takes, unless ``encoding``,
            ``jpeg_quality`` or ``output.map_step`` fix them. ``"fixed"``: send what was asked for,
            within the credit. Default: ``"auto"`` for live sessions with a server elsewhere.
            :attr:`BlockingSession.link` shows the choice.
        clock
            A function that returns the present time of the clock of ``capture_ns``, in nanoseconds:
            ``time.time_ns`` for ROS, or that of your runtime. Ages are then those of this clock,
            and a frame of an impossible time is refused. Default: ``time.monotonic_ns``.
        tracked_from_left
            Maps left-camera coordinates to those of the body whose poses ``session.track`` gets,
            in the session's axes; default: the left camera itself is tracked.
        pose_offset_s
            The time in seconds to add to ``capture_ns`` to get the time of the frame's pose, as
            Kalibr's ``timeshift_cam_imu``.
        open_timeout_s
            The time in seconds for which a server that cannot be reached, is not ready or has no
            room is asked again.

        Raises
        ------
        BadShape
            The stream id has other characters or another length.
        BadCalibration
            ``left_from_right`` is no rigid transform.
        NotOpen
            The client is not open.
        """
        session = self._client.open_session(
            rig,
            axes=axes,
            delivery=delivery,
            output=output,
            iterations=iterations,
            cold_iterations=cold_iterations,
            weights_sha256=weights_sha256,
            encoding=encoding,
            jpeg_quality=jpeg_quality,
            stream_id=stream_id,
            resume_token=resume_token,
            on_event=on_event,
            on_lost=on_lost,
            link=link,
            clock=clock,
            tracked_from_left=tracked_from_left,
            pose_offset_s=pose_offset_s,
            open_timeout_s=open_timeout_s,
        )
        return BlockingSession(session, self._loop)

    def server_info(self) -> ServerInfo:
        """Return the server's version, model and limits.

        Raises
        ------
        ConnectionLost
            The server cannot be reached.
        NotReady
            The server is starting, or the address does not belong to a Vergence server.
        NotOpen
            The client is not open.
        """
        return self._loop.wait(self._client.server_info())

    def stream_info(self, stream_id: str) -> StreamInfo:
        """Return the counters of one stream.

        Without a token, only a stream that this client opened is known to the server.

        Raises
        ------
        UnknownStream
            No stream of this id is open, and none was in the last minutes.
        StreamExpired
            The stream was idle or detached for too long and was discarded.
        ConnectionLost
            The server cannot be reached.
        NotOpen
            The client is not open.
        """
        return self._loop.wait(self._client.stream_info(stream_id))

    def close_stream(self, stream_id: str) -> None:
        """End a stream, and free its state.

        With a token, it may be held by another client of the same principal. Without one, only a
        stream that this client opened is known to the server.

        Raises
        ------
        UnknownStream
            No stream of this id is open.
        ConnectionLost
            The server cannot be reached.
        NotOpen
            The client is not open.
        """
        self._loop.wait(self._client.close_stream(stream_id))
