"""The client of one server, with any number of sessions."""

import uuid
import weakref
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Literal, Self

from vergence.attaching import OnLost, RecoveryRules
from vergence.capture_clock import CaptureClock
from vergence.errors import NotOpen
from vergence.image_format import ImageFormat
from vergence.info import ServerInfo, StreamInfo
from vergence.info_codec import server_info_from_proto, stream_info_from_proto
from vergence.link import LinkRules
from vergence.pose_buffer import PoseBuffer
from vergence.results import SessionEvent
from vergence.session import DepthSession
from vergence.session_facts import SessionSetup
from vergence.transports.addresses import DEFAULT_SERVER, connector, on_this_machine
from vergence.transports.base import Transport
from vergence.units import warn_of_baseline
from vergence_proto import codec
from vergence_proto.geometry import Axes, Matrix, Pose, RectifiedRig
from vergence_proto.types import (
    Delivery,
    ImageEncoding,
    OutputFormat,
    PlaneEncoding,
    StereoRig,
    checked_stream_id,
)
from vergence_proto.v1 import depth_pb2 as pb

_THREADS = 2  # one encodes while the other decodes


class DepthClient:
    """A connection to a server, opened at the first request. Use it inside ``async with``.

    Use a client from one event loop. Every method raises :class:`NotOpen` outside ``async with``.

    Parameters
    ----------
    server
        ``grpc://HOST:PORT``; or ``zenoh://HOST:PORT[/NAMESPACE][?config=FILE]``, the address of a
        Zenoh router or of a server that is one; or ``http://HOST:PORT`` (or ``https``), for
        networks that let nothing else through. ``grpcs`` and ``https`` are encrypted.
    token
        The token that the server asks for. Default: the environment's ``VERGENCE_TOKEN``, or the
        content of the file ``VERGENCE_TOKEN_FILE``.
    ca
        PEM file of the authority that signed the server's certificate. Default: the environment's
        ``VERGENCE_CA``, or those that this system trusts.
    cert, key
        PEM files of the client's own certificate, for servers that ask for one.

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
        self._server = server
        self._connect = connector(server, token=token, ca=ca, cert=cert, key=key)
        self._sessions: weakref.WeakSet[DepthSession] = weakref.WeakSet()
        self._on_this_machine = on_this_machine(server)
        self._transport: Transport | None = None
        self._threads: Executor

    async def __aenter__(self) -> Self:
        """Make the client ready; this does not connect yet."""
        self._transport = self._connect()
        # Of its own: asyncio's default threads may be busy with anything.
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="vergence-images")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """Close the connection; sessions that are still open end with ConnectionLost."""
        transport, self._transport = self._transport, None
        if transport is not None:
            await transport.close()
            self._threads.shutdown(wait=False)

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
    ) -> DepthSession:
        """Make a session; its ``async with`` opens the stream and ends it.

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
            client interpolates (:attr:`vergence.DepthResult.raw` is as received); else every pixel,
            to 1/64 px; compressed without further loss, unless the server is on this machine.
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
            Called in the event loop with each :class:`SessionEvent`; it must not block.
        on_lost
            What to do when the server does not have the stream any more, because it was restarted
            or has discarded the stream. ``"restart"``: go on with a new stream, whose first result
            is a cold start. ``"raise"``: end the session with the error.
        link
            ``"auto"``: measure the link, send frames at the pace of its slowest part, and choose
            the quality of JPEG, half size and ``map_step`` by what it takes, unless ``encoding``,
            ``jpeg_quality`` or ``output.map_step`` fix them. ``"fixed"``: send what was asked for,
            within the credit. Default: ``"auto"`` for live sessions with a server elsewhere.
            :attr:`DepthSession.link` shows the choice.
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
        BadPose
            ``tracked_from_left`` is no rigid transform.
        NotOpen
            The client is not open.
        """
        if link not in (None, "auto", "fixed"):
            raise ValueError(f"expected link as 'auto' or 'fixed', got {link!r}")
        if tracked_from_left is not None and not isinstance(tracked_from_left, Pose):
            tracked_from_left = Pose.from_matrix(tracked_from_left)
        transport = self._open_transport()
        small = delivery is Delivery.NEWEST and not self._on_this_machine
        warn_of_baseline(rig)
        adapts = delivery is Delivery.NEWEST and (link == "auto" or (small and link is None))
        chosen = (output or OutputFormat(compressed=adapts or not self._on_this_machine)).resolved(
            small=small or adapts
        )
        opening = pb.OpenStream(
            stream_id=checked_stream_id(uuid.uuid4().hex if stream_id is None else stream_id),
            resume_token=resume_token,
            rig=codec.rig_to_proto(
                StereoRig.from_rectified(rig) if isinstance(rig, RectifiedRig) else rig
            ),
            axes=codec.axes_to_proto(axes),
            delivery=codec.delivery_to_proto(delivery),
            output=codec.output_format_to_proto(chosen),
            iterations=iterations,
            cold_iterations=cold_iterations,
            weights_sha256=weights_sha256,
            paces=adapts,
        )
        session = DepthSession(
            SessionSetup(
                transport=transport,
                opening=opening,
                delivery=delivery,
                link=LinkRules(
                    images=_image_format(encoding, jpeg_quality, small=small or adapts),
                    map_step=chosen.map_step,
                    adapts=adapts,
                    fixed_images=encoding is not None or jpeg_quality is not None,
                    fixed_maps=(output is not None and output.map_step != 0)
                    or chosen.encoding is not PlaneEncoding.UINT16,
                ),
                threads=self._threads,
                on_event=on_event,
                rules=RecoveryRules(on_lost, open_timeout_s),
                clock=CaptureClock(clock, live=delivery is Delivery.NEWEST),
                poses=PoseBuffer(tracked_from_left, pose_offset_s),
            )
        )
        self._sessions.add(session)
        return session

    async def server_info(self) -> ServerInfo:
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
        request = pb.GetServerInfoRequest()
        transport = self._open_transport()
        response = await transport.ask("GetServerInfo", request, pb.GetServerInfoResponse)
        return server_info_from_proto(response)

    async def stream_info(self, stream_id: str) -> StreamInfo:
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
        request = pb.GetStreamRequest(
            stream_id=stream_id, resume_token=self._resume_token(stream_id)
        )
        transport = self._open_transport()
        response = await transport.ask("GetStream", request, pb.GetStreamResponse)
        return stream_info_from_proto(response)

    async def close_stream(self, stream_id: str) -> None:
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
        request = pb.CloseStreamRequest(
            stream_id=stream_id, resume_token=self._resume_token(stream_id)
        )
        await self._open_transport().ask("CloseStream", request, pb.CloseStreamResponse)

    def _resume_token(self, stream_id: str) -> bytes:
        """Return the secret of a stream of this client; empty if it has none of this id."""
        theirs = (each for each in self._sessions if each.stream_id == stream_id)
        tokens = [known for each in theirs if (known := each.known_token)]
        return tokens[-1] if tokens else b""

    def _open_transport(self) -> Transport:
        if self._transport is None:
            raise NotOpen(
                f"the client is not open; write: async with DepthClient({self._server!r}) as client"
            )
        return self._transport


def _image_format(
    encoding: ImageEncoding | None, jpeg_quality: int | None, *, small: bool
) -> ImageFormat:
    if encoding is None and (small or jpeg_quality is not None):
        return ImageFormat(ImageEncoding.JPEG, jpeg_quality or 80, grey=True)
    return ImageFormat(encoding or ImageEncoding.RAW, jpeg_quality or 90)
