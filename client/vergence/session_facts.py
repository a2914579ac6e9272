"""What a session knows of its stream, the same for asynchronous and blocking callers."""

import os
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vergence.attaching import RecoveryRules
from vergence.capture_clock import CaptureClock
from vergence.connection import StreamConnection
from vergence.errors import NotOpen
from vergence.in_flight import FramesInFlight
from vergence.info import ModelInfo
from vergence.info_codec import model_info_from_proto
from vergence.link import LinkRules, LinkState, SessionLink
from vergence.pose_buffer import PoseBuffer
from vergence.raw_pixels import image_pixels
from vergence.recording import SessionRecording
from vergence.reprojection import DepthView, Fill, View
from vergence.responses import ResponseRouter
from vergence.results import DepthResult, Drops, SessionEvent, SessionState
from vergence.transports.base import Transport
from vergence_proto import codec
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import Delivery, PoseSample
from vergence_proto.v1 import depth_pb2 as pb


@dataclass(frozen=True, slots=True, eq=False)
class SessionSetup:
    """The choices of :meth:`vergence.DepthClient.open_session`, which alone makes sessions."""

    transport: Transport
    opening: pb.OpenStream
    delivery: Delivery
    link: LinkRules
    threads: Executor  # for work on whole images
    on_event: Callable[[SessionEvent], None] | None
    rules: RecoveryRules
    clock: CaptureClock
    poses: PoseBuffer


@dataclass(frozen=True, slots=True, eq=False)
class SessionParts:
    """The parts that a session is made of."""

    setup: SessionSetup
    in_flight: FramesInFlight
    responses: ResponseRouter
    connection: StreamConnection
    link: SessionLink

    @classmethod
    def of(cls, setup: SessionSetup) -> Self:
        in_flight = FramesInFlight()
        axes = codec.axes_from_proto(setup.opening.axes)
        responses = ResponseRouter(
            in_flight,
            axes,
            setup.threads,
            setup.clock,
            paces=setup.link.adapts,
            lossless=setup.delivery is Delivery.EVERY,
        )
        link = SessionLink(setup.link)
        connection = StreamConnection(
            setup.transport, setup.opening, responses, setup.on_event, setup.rules, link
        )
        return cls(setup, in_flight, responses, connection, link)

    def opened(self) -> pb.StreamOpened:
        """Return how the server opened the stream. Raises NotOpen: it did not yet."""
        if self.responses.opened is None:
            raise NotOpen(
                "the session is not open; write: async with client.open_session(rig) as session"
            )
        return self.responses.opened


class SessionFacts:
    """What can be read of a session, in any thread and at any time after it was opened."""

    def __init__(self, parts: SessionParts, /) -> None:
        self._parts = parts

    @property
    def stream_id(self) -> str:
        """The id of the stream on the server."""
        return self._parts.setup.opening.stream_id

    @property
    def resume_token(self) -> bytes:
        """The secret with which another session can take this stream over, by its stream id."""
        return self._parts.opened().resume_token

    @property
    def known_token(self) -> bytes:
        """The resume token, or nothing before the server has opened the stream."""
        return self._parts.setup.opening.resume_token

    @property
    def rig(self) -> RectifiedRig:
        """The rig of every result: the one of ``open_session``, or its rectification."""
        self._parts.opened()
        return self._parts.responses.rig

    @property
    def left_from_rectified(self) -> Pose:
        """Maps rectified-left to left-camera coordinates, in OpenCV axes: a rotation.

        It is the identity if the rig of ``open_session`` is rectified.
        """
        opened = self._parts.opened()
        if not opened.HasField("left_from_rectified"):
            return Pose.identity()
        return codec.pose_from_proto(opened.left_from_rectified)

    def image_pixels(self) -> NDArray[np.float32]:
        """Return where each pixel of a map is in the left image as the camera took it.

        The camera's own image can so be coloured by a map, or a map by the image
        (``cv2.remap(image, pixels, None, cv2.INTER_LINEAR)`` is the rectified image).

        Returns
        -------
        NDArray[np.float32]
            [H, W, 2], pixels (x, y). A pixel that the camera did not see lies outside the image.
        """
        rig = self.rig  # first: it raises NotOpen
        camera = codec.rig_from_proto(self._parts.setup.opening.rig).left
        return image_pixels(camera, rig, self.left_from_rectified)

    @property
    def model(self) -> ModelInfo:
        """The model that steps this stream."""
        return model_info_from_proto(self._parts.opened().model)

    @property
    def credit(self) -> int:
        """The number of frames that may be unanswered at once."""
        self._parts.opened()
        return self._parts.in_flight.credit

    @property
    def drops(self) -> Drops:
        """The frames that never became a result, until now."""
        return self._parts.in_flight.drops

    @property
    def round_trip_s(self) -> float | None:
        """Network time in seconds, there and back, of the latest ping; None before the first."""
        return self._parts.connection.round_trip_s

    def track(self, t_ns: int, world_from_tracked: Pose | PoseSample | Matrix) -> None:
        """Add a pose of the tracker; frames without a pose then get one, interpolated.

        Any thread may call it, at the tracker's own rate. A frame that is submitted without a pose
        has that of ``capture_ns + pose_offset_s``, times ``tracked_from_left`` (both of
        ``open_session``). Poses must be tracked before the frames between them are submitted.

        Parameters
        ----------
        t_ns
            The time of the pose in nanoseconds, on the clock of ``capture_ns``; it ascends.
        world_from_tracked
            The pose of the tracked body, in the session's axes and metres; a matrix is [3, 4] or
            [4, 4].

        Raises
        ------
        BadPose
            The pose is not finite or no rigid transform, or its time is not after the latest.
        """
        if not isinstance(world_from_tracked, (Pose, PoseSample)):
            world_from_tracked = Pose.from_matrix(world_from_tracked)
        if isinstance(world_from_tracked, Pose):
            world_from_tracked = PoseSample(world_from_tracked)
        self._parts.setup.poses.add(t_ns, world_from_tracked)

    @property
    def link(self) -> LinkState:
        """What the session measured of its link, what it chose, and what limits it."""
        self._parts.opened()
        return self._parts.link.state

    @property
    def state(self) -> SessionState:
        """The state of the connection; silence shows after 1 s, or three round trips."""
        self._parts.opened()
        return self._parts.connection.state

    @property
    def latest(self) -> DepthResult | None:
        """The newest result so far; None before the first. Any thread may read it, at any time."""
        return self._parts.responses.recent.latest

    def record(self, path: str | os.PathLike[str]) -> SessionRecording:
        """Record the frames that are answered from now on, with their results, into an MCAP file.

        Foxglove and other viewers open the file. ``vergence run mcap:FILE`` replays it, and gives
        the same results, bit for bit, if it was recorded from the stream's first frame on. The
        recording ends with its ``with`` block or with the session.

        Parameters
        ----------
        path
            The file to write; one that is there is replaced.

        Raises
        ------
        NotOpen
            The session is not open.
        ImportError
            The packages of the extra ``record`` are not installed.
        OSError
            The file cannot be written.
        RuntimeError
            The session is being recorded already.
        """
        opened = self._parts.opened()
        responses = self._parts.responses
        if responses.recording is not None and responses.recording.is_open:
            raise RuntimeError("this session is being recorded; close that recording first")
        responses.recording = SessionRecording(Path(path), self._parts.setup.opening, opened)
        return responses.recording

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
        return self._parts.responses.recent.depth_at(
            world_from_view, view, at_ns=at_ns, fill=fill, max_age_s=max_age_s
        )
