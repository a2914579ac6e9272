"""Recording of a session into an MCAP file, in the layout of :mod:`vergence_proto.recordings`."""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from vergence.depth_formats import webxr
from vergence.results import DepthResult
from vergence_proto import codec, recordings
from vergence_proto.extras import how_to_install
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Distortion, Intrinsics, StereoRig
from vergence_proto.v1 import depth_pb2 as pb

if TYPE_CHECKING:
    from google.protobuf.message import Message
    from mcap.writer import Writer

log: logging.Logger = logging.getLogger("vergence")

# A disk that is slower than the camera must not fill the memory with images.
_MOST_WAITING = 32
_NS_PER_S = 1_000_000_000
_MODELS = {
    Distortion.NONE: "",
    Distortion.BROWN_CONRADY: "rational_polynomial",
    Distortion.KANNALA_BRANDT: "kannala_brandt",
}
_COMPRESSED = {pb.IMAGE_ENCODING_JPEG: "jpeg", pb.IMAGE_ENCODING_PNG: "png"}
_RAW = {pb.IMAGE_ENCODING_MONO8: ("mono8", 1), pb.IMAGE_ENCODING_RGB8: ("rgb8", 3)}


class SessionRecording:
    """The recording of a session. :meth:`vergence.DepthSession.record` makes it; use ``with``.

    A thread of its own writes the frames that were answered with a map. If it cannot keep up, it
    leaves frames out and counts them.
    """

    def __init__(self, path: Path, opening: pb.OpenStream, opened: pb.StreamOpened, /) -> None:
        self.frames: int = 0
        """The number of frames in the file."""
        self.frames_left_out: int = 0
        """The number of answered frames that are not in the file, because the disk was too slow."""
        self._sent: dict[int, bytes] = {}
        self._file = _RecordingFile(path, opening, opened)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="vergence-recording")
        self._waiting: set[Future[None]] = set()
        self._failure: Exception | None = None
        self._open = True

    def __enter__(self) -> Self:
        """Return the recording, which has begun."""
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file, as :meth:`close` does."""
        self.close()

    @property
    def is_open(self) -> bool:
        """True until the recording is closed."""
        return self._open

    def close(self) -> None:
        """Write what is still waiting and close the file. A second call does nothing.

        Raises
        ------
        OSError
            A frame could not be written; the file ends before it.
        """
        if not self._open:
            return
        self._open = False
        self._thread.shutdown(wait=True)
        self._sent.clear()
        self._file.close()
        if self._failure is not None:
            raise self._failure

    def sent(self, frame_id: int, request: bytes) -> None:
        """Keep the request of a frame until its answer comes."""
        if self._open:
            self._sent[frame_id] = request

    def unanswered(self, frame_id: int) -> None:
        """Discard a frame that will have no map."""
        self._sent.pop(frame_id, None)

    def answered(self, message: pb.DisparityMap, result: DepthResult) -> None:
        """Write a frame and its answer, in the recording's thread."""
        request = self._sent.pop(message.frame_id, None)
        if request is None or not self._open or self._failure is not None:
            return
        if len(self._waiting) >= _MOST_WAITING:
            if not self.frames_left_out:
                log.warning("the recording leaves frames out: its disk is slower than the camera")
            self.frames_left_out += 1
            return
        self.frames += 1
        work = self._thread.submit(self._file.add, request, message, result)
        self._waiting.add(work)
        work.add_done_callback(self._written)

    def _written(self, work: Future[None]) -> None:
        self._waiting.discard(work)
        if (error := work.exception()) is not None and self._failure is None:
            self._failure = error if isinstance(error, Exception) else RuntimeError(str(error))
            log.error("the recording has stopped: %s", error)


class _RecordingFile:
    """An MCAP file that is being written."""

    def __init__(self, path: Path, opening: pb.OpenStream, opened: pb.StreamOpened) -> None:
        try:
            import foxglove_schemas_protobuf  # noqa: F401  # its messages are imported later
            from mcap.writer import Writer
        except ImportError:
            raise ImportError(
                f"a recording needs mcap, which is not installed: {how_to_install('record')}"
            ) from None
        self._file = path.open("wb")
        self._writer: Writer = Writer(self._file)
        self._writer.start(library="vergence")
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._axes = codec.axes_from_proto(opening.axes)
        self._log_time_ns = time.time_ns()
        self._begin(opening, opened)

    def _begin(self, opening: pb.OpenStream, opened: pb.StreamOpened) -> None:
        opening_without_secrets = pb.OpenStream()
        opening_without_secrets.CopyFrom(opening)
        opened_without_secrets = pb.StreamOpened()
        opened_without_secrets.CopyFrom(opened)
        for secret in ("resume_token", "opening_id"):
            opening_without_secrets.ClearField(secret)
        opened_without_secrets.ClearField("resume_token")
        self._add(recordings.STREAM, opening_without_secrets, 0)
        self._add(recordings.OPENED, opened_without_secrets, 0)
        rig = codec.rig_from_proto(opening.rig)
        left, right = _calibrations(rig)
        self._add(recordings.LEFT_CALIBRATION, left, 0)
        self._add(recordings.RIGHT_CALIBRATION, right, 0)
        rectified = codec.rectified_rig_from_proto(opened.rig)
        self._add(recordings.DEPTH_CALIBRATION, _rectified_calibration(rectified), 0)

    def add(self, request: bytes, answer: pb.DisparityMap, result: DepthResult) -> None:
        """Write one frame and its answer."""
        self._log_time_ns = max(time.time_ns(), self._log_time_ns + 1)
        frame = pb.StreamDepthRequest.FromString(request).frame
        capture_ns = frame.capture_ns
        for image, topic, camera in (
            (frame.left, recordings.LEFT_IMAGE, "left"),
            (frame.right, recordings.RIGHT_IMAGE, "right"),
        ):
            self._add(topic, _image(image, camera, capture_ns), capture_ns)
            image.ClearField("data")
        self._add(recordings.FRAME, frame, capture_ns)
        self._add(recordings.DISPARITY, answer, capture_ns)
        self._add(recordings.DEPTH_IMAGE, _depth_image(result), capture_ns)
        if result.world_from_left is not None:
            pose = self._axes.to_opencv(result.world_from_left)
            self._add(recordings.TRANSFORMS, _transform(pose, capture_ns), capture_ns)

    def close(self) -> None:
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap states no type here
        finally:
            self._file.close()

    def _add(self, topic: str, message: Message, capture_ns: int) -> None:
        self._writer.add_message(
            self._channel(topic, message),
            log_time=self._log_time_ns,
            data=message.SerializeToString(),
            publish_time=max(capture_ns, 0),  # MCAP has no time before 1970
        )

    def _channel(self, topic: str, message: Message) -> int:
        name = message.DESCRIPTOR.full_name
        if (topic, name) not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    name, "protobuf", recordings.schema_of(message)
                )
            self._channels[topic, name] = self._writer.register_channel(
                topic, "protobuf", self._schemas[name]
            )
        return self._channels[topic, name]


def _image(image: pb.Image, camera: str, capture_ns: int) -> Message:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    if image.encoding in _COMPRESSED:
        message: Any = CompressedImage(
            frame_id=camera, format=_COMPRESSED[image.encoding], data=image.data
        )
    else:
        encoding, channels = _RAW[image.encoding]
        message = RawImage(
            frame_id=camera,
            width=image.width,
            height=image.height,
            encoding=encoding,
            step=image.width * channels,
            data=image.data,
        )
    return _stamped(message, capture_ns)


def _depth_image(result: DepthResult) -> Message:
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    millimetres = webxr(result.depth_m, meters_per_unit=0.001)
    height, width = millimetres.shape
    return _stamped(
        RawImage(
            frame_id="left",
            width=width,
            height=height,
            encoding="16UC1",
            step=2 * width,
            data=millimetres.astype("<u2").tobytes(),
        ),
        result.capture_ns,
    )


def _transform(world_from_left: Pose, capture_ns: int) -> Message:
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    message = FrameTransform(parent_frame_id="world", child_frame_id="left")
    message.translation.x, message.translation.y, message.translation.z = (
        world_from_left.translation_m
    )
    x, y, z, w = world_from_left.orientation_xyzw
    message.rotation.x, message.rotation.y = x, y
    message.rotation.z, message.rotation.w = z, w
    return _stamped(message, capture_ns)


def _calibrations(rig: StereoRig) -> tuple[Message, Message]:
    rectified = rig.as_rectified()
    offset = 0.0 if rectified is None else -rectified.fx * rectified.baseline_m
    return _calibration(rig.left, "left", 0.0), _calibration(rig.right, "right", offset)


def _calibration(camera: Intrinsics, name: str, offset: float) -> Message:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    k = camera.matrix
    return CameraCalibration(
        frame_id=name,
        width=camera.width,
        height=camera.height,
        distortion_model=_MODELS[camera.distortion],
        D=camera.coefficients,
        K=k.ravel(),
        R=(1, 0, 0, 0, 1, 0, 0, 0, 1),
        P=(*k[0], offset, *k[1], 0, *k[2], 0),
    )


def _rectified_calibration(rig: RectifiedRig) -> Message:
    camera = Intrinsics(rig.width, rig.height, rig.fx, rig.fy, rig.cx_left, rig.cy)
    return _calibration(camera, "left", 0.0)


def _stamped(message: Any, capture_ns: int) -> Message:
    message.timestamp.seconds, message.timestamp.nanos = divmod(max(capture_ns, 0), _NS_PER_S)
    stamped: Message = message
    return stamped
