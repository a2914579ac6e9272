"""Recordings of sessions: ``mcap:walk.mcap``, as :mod:`vergence_proto.recordings` describes them.

Images and poses are those that the server got, so that a replay gives the same results, bit for
bit. Reading needs the package mcap, which the extra ``record`` brings.
"""

import errno
import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import Message

from vergence_proto import codec, recordings
from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.listing import is_data
from vergence_proto.datasets.source import FrameFiles, SourceFrame, StereoSource
from vergence_proto.errors import DepthError
from vergence_proto.extras import how_to_install
from vergence_proto.geometry import Axes, Matrix, Pose
from vergence_proto.types import PoseSample, StereoFrame
from vergence_proto.v1 import depth_pb2 as pb

if TYPE_CHECKING:
    from mcap.reader import McapReader

_SCHEMAS: dict[str, type[Message]] = {
    recordings.STREAM: pb.OpenStream,
    recordings.FRAME: pb.Frame,
    recordings.DISPARITY: pb.DisparityMap,
}
_IMAGES = (recordings.LEFT_IMAGE, recordings.RIGHT_IMAGE)
# After these the stream had no memory, for a reason that a replay does not have by itself.
_RESETS = (pb.ORIGIN_COLD_START, pb.ORIGIN_RESET_REQUESTED)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedOptions:
    """What a replay needs besides the frames."""

    axes: Axes
    """The axes of the poses that were sent."""
    iterations: int
    """Refinement iterations of the warm steps; 0: there were none."""
    cold_iterations: int
    """Refinement iterations of the cold starts; 0: there were none."""
    resets: frozenset[int]
    """Indices of the frames, after the first, before which the stream's memory was discarded."""


class _SentPose(Pose):
    """A pose that is encoded as the quaternion that was sent, to the bit."""

    __slots__ = ("_sent_xyzw",)

    def __init__(self, pose: Pose, sent_xyzw: Matrix) -> None:
        super().__init__(pose.rotation, pose.translation_m)
        object.__setattr__(self, "_sent_xyzw", sent_xyzw)

    @property
    def orientation_xyzw(self) -> Matrix:
        sent_xyzw: Matrix = self._sent_xyzw  # type: ignore[attr-defined]  # a slot set in __init__
        return sent_xyzw


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSource(StereoSource):
    """A recording as a source."""

    options: RecordedOptions | None = None
    """What a replay needs besides the frames."""
    log_times_ns: tuple[int, ...] = ()
    """The log time of each frame in the file."""
    as_sent: bool = False
    """Read frames as they were sent: their poses have the recorded axes."""

    def __getitem__(self, index: int) -> SourceFrame:
        """Read a frame. Raises DatasetError."""
        frame = self._sent(index)
        if self.as_sent:
            return SourceFrame(frame)
        files = self.files[index]
        pose = None if files.world_from_left is None else PoseSample(files.world_from_left)
        return SourceFrame(
            StereoFrame(frame.frame_id, frame.capture_ns, frame.left, frame.right, pose)
        )

    def _sent(self, index: int) -> StereoFrame:
        path, log_time_ns = self.files[index].left, self.log_times_ns[index]
        message = pb.Frame()
        images: dict[str, bytes] = {}
        with _opened(path) as reader:
            topics = [recordings.FRAME, *_IMAGES]
            for schema, channel, stored in reader.iter_messages(
                topics, starting_at=log_time_ns, ending_at=log_time_ns, log_time_order=False
            ):
                if channel.topic == recordings.FRAME:
                    message.MergeFromString(stored.data)
                elif schema is not None:
                    images[channel.topic] = _image_data(schema.name, stored.data)
        try:
            message.left.data, message.right.data = (images[topic] for topic in _IMAGES)
        except KeyError as missing:
            raise DatasetError(f"{path}: frame {message.frame_id} has no {missing}") from None
        left = self.rig.left
        try:
            frame = codec.frame_from_proto(message, size=(left.width, left.height))
        except DepthError as error:
            raise DatasetError(f"{path}: frame {message.frame_id}: {error}") from None
        return StereoFrame(
            1 + range(len(self))[index],
            frame.capture_ns,
            frame.left,
            frame.right,
            _sent_pose(message, frame.pose),
        )


def open_path(path: Path) -> RecordedSource:
    """Open a recording: read its options, poses and times; images are read when they are used.

    Raises DatasetError: the file is damaged, was cut, or is no recording of a session.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: expected an MCAP file, a recording of a session; found none")
    openings: list[pb.OpenStream] = []
    frames: list[tuple[int, pb.Frame]] = []
    maps: dict[int, pb.DisparityMap] = {}
    with _opened(path) as reader:
        for _, channel, stored in reader.iter_messages([*_SCHEMAS]):
            message: Any = _SCHEMAS[channel.topic].FromString(stored.data)
            match message:
                case pb.OpenStream():
                    openings.append(message)
                case pb.Frame():
                    frames.append((stored.log_time, message))
                case pb.DisparityMap():
                    for plane in ("disparity", "confidence", "sigma"):
                        message.ClearField(plane)
                    maps[stored.log_time] = message
    if not openings:
        raise DatasetError(
            f"{path}: expected a recording of a session, with the topic {recordings.STREAM}; "
            "this MCAP file has none"
        )
    return _source(path, openings[0], frames, [maps.get(at_ns) for at_ns, _ in frames])


def find(folder: Path) -> list[Path]:
    """List the MCAP files in or under a folder."""
    if folder.is_file():
        return [folder] if folder.suffix == ".mcap" else []
    return sorted(
        each
        for each in folder.rglob("*.mcap")
        if each.is_file() and all(map(is_data, each.relative_to(folder).parts))
    )


def _source(
    path: Path,
    opening: pb.OpenStream,
    frames: list[tuple[int, pb.Frame]],
    maps: list[pb.DisparityMap | None],
) -> RecordedSource:
    try:
        rig = codec.rig_from_proto(opening.rig)
        axes = codec.axes_from_proto(opening.axes)
        poses = [
            codec.pose_sample_from_proto(frame.pose) if frame.HasField("pose") else None
            for _, frame in frames
        ]
    except DepthError as error:
        raise DatasetError(f"{path}: {error}") from None
    times_ns = np.array([frame.capture_ns for _, frame in frames], np.int64)
    steps_ns = np.diff(times_ns)
    answered = [each for each in maps if each is not None]
    cold = [each for each in answered if each.step_count == 1]
    warm = [each for each in answered if each.step_count > 1]
    return RecordedSource(
        path.stem,
        rig,
        fps=1e9 / float(np.median(steps_ns)) if (steps_ns > 0).any() else None,
        files=[
            FrameFiles(
                path,
                path,
                frame.capture_ns,
                None if pose is None else axes.to_opencv(pose.world_from_left),
            )
            for (_, frame), pose in zip(frames, poses, strict=True)
        ],
        options=RecordedOptions(
            axes,
            iterations=warm[0].iterations if warm else 0,
            cold_iterations=cold[0].iterations if cold else 0,
            resets=frozenset(
                index
                for index, each in enumerate(maps)
                if index > 0 and each is not None and each.origin in _RESETS
            ),
        ),
        log_times_ns=tuple(at_ns for at_ns, _ in frames),
        notes=tuple(_notes(path, maps)),
    )


def _notes(path: Path, maps: list[pb.DisparityMap | None]) -> Iterator[str]:
    counts = [0 if each is None else each.step_count for each in maps]
    if counts and counts[0] > 1:
        yield (
            f"{path} begins in the middle of a stream: until its memory has settled, a replay "
            "differs from what was recorded"
        )
    lost = sum(count not in (1, before + 1) for before, count in itertools.pairwise(counts))
    if lost:
        yield f"{path} lacks frames in {lost} places: a replay differs from what was recorded"


def _sent_pose(message: pb.Frame, pose: PoseSample | None) -> PoseSample | None:
    if pose is None:
        return None
    sent = message.pose.world_from_left.orientation
    xyzw = np.array([sent.x, sent.y, sent.z, sent.w])
    if not pose.orientation_valid:  # what was sent is undefined, and need not be a rotation
        return pose
    return PoseSample(
        _SentPose(pose.world_from_left, xyzw),
        pose.orientation_valid,
        pose.position_valid,
        pose.tracked,
    )


def _image_data(schema: str, message: bytes) -> bytes:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    raw = schema == RawImage.DESCRIPTOR.full_name
    return (RawImage if raw else CompressedImage).FromString(message).data


@contextmanager
def _opened(path: Path) -> Iterator["McapReader"]:
    """Open an MCAP file; errors of the file become DatasetError."""
    try:
        import foxglove_schemas_protobuf  # noqa: F401  # the images are read later
        from mcap.reader import make_reader
    except ImportError:
        raise DatasetError(
            f"{path}: reading a recording needs mcap, which is not installed: "
            f"{how_to_install('record')}"
        ) from None
    with path.open("rb") as file:
        try:
            yield make_reader(file)
        except DatasetError:
            raise
        except Exception as error:  # mcap lets those of struct, lz4 and zstandard through
            # It seeks before the start of a file that is shorter than its footer.
            if isinstance(error, OSError) and error.errno != errno.EINVAL:
                raise
            raise DatasetError(
                f"{path}: this MCAP file was cut or is damaged ({type(error).__name__}: {error})"
            ) from None
