"""The result of a job on disk.

::

    result/run.json         what made it: versions, weights, the rectified rig, see ``Made``
    result/000000.frame     one frame, see :mod:`vergence_proto.job_results.frame_file`

A frame that could not be read or stepped has a file too, with the reason instead of a map.
"""

import dataclasses
import itertools
import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vergence_proto.datasets import StereoSource
from vergence_proto.errors import BadImage, DepthError
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.job_results.frame_file import (
    SUFFIX,
    JobFrame,
    decode_frame,
    decode_record,
    is_whole,
)
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.jobs import JobOutput

_RUN = "run.json"
_LONGEST_RECORD = 1 << 16
# Bytes per pixel that planes of 1/64 px take at most in practice, compressed.
_BYTES_A_PIXEL = {JobOutput.CONFIDENCE: 0.75, JobOutput.SIGMA: 1.5}
_DISPARITY_BYTES_A_PIXEL = 1.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What made a result, and the cameras that its maps belong to."""

    vergence: str  # version of the server
    model: str
    weights_sha256: str
    engine: str  # what computed it
    provider: str
    rig: RectifiedRig | None  # None: no frame has a map
    left_from_rectified: Pose | None  # the rectifying rotation

    def to_json(self) -> str:
        values = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        if self.rig is not None:
            values["rig"] = dataclasses.asdict(self.rig)
        if self.left_from_rectified is not None:
            values["left_from_rectified"] = self.left_from_rectified.matrix.tolist()
        return json.dumps(values)

    @classmethod
    def from_json(cls, text: str) -> "Made":
        values: dict[str, Any] = json.loads(text)
        if values["rig"] is not None:
            values["rig"] = RectifiedRig(**values["rig"])
        if values["left_from_rectified"] is not None:
            values["left_from_rectified"] = Pose.from_matrix(values["left_from_rectified"])
        return cls(**values)


def start_result(folder: Path, made: Made) -> None:
    """Begin a result, and delete the files of earlier attempts."""
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    write_made(folder, made)


def write_made(folder: Path, made: Made) -> None:
    """Write what makes a result; the rig is known with the first map."""
    (folder / _RUN).write_text(made.to_json(), "utf-8")


def read_made(folder: Path) -> Made:
    """Read what made a result. Raises OSError: it has not begun."""
    return Made.from_json((folder / _RUN).read_text("utf-8"))


def write_frame(folder: Path, index: int, content: bytes) -> None:
    """Write the file of one frame; a reader sees all of it or nothing."""
    path = frame_path(folder, index)
    unfinished = path.with_suffix(".new")
    unfinished.write_bytes(content)
    unfinished.replace(path)


def has_frames(folder: Path) -> bool:
    """Return whether any frame is done."""
    return next(folder.glob(f"*{SUFFIX}"), None) is not None


def frame_path(folder: Path, index: int) -> Path:
    """Return the path of the file of one frame."""
    return folder / f"{index:06d}{SUFFIX}"


def result_bytes(sequence: StereoSource, outputs: Collection[JobOutput]) -> int:
    """Estimate the disk space that the result of a sequence will need."""
    pixels = sequence.rig.left.width * sequence.rig.left.height
    bytes_a_pixel = _DISPARITY_BYTES_A_PIXEL + sum(_BYTES_A_PIXEL.get(each, 0) for each in outputs)
    left = 0
    if JobOutput.LEFT in outputs:
        left = sum(each.left.stat().st_size for each in sequence.files if each.left.is_file())
    return round(len(sequence) * pixels * bytes_a_pixel) + left


def checking_frames(folder: Path, count: int) -> Iterator[bool]:
    """Yield for each of the first ``count`` files, and for what made them, if it is complete.

    A crash may have cut off the last ones. Nothing follows the first that is not complete.
    """
    try:
        read_made(folder)
        yield True
        for index in range(count):
            complete = is_whole(frame_path(folder, index).read_bytes())
            yield complete
            if not complete:
                return
    except (OSError, TypeError, ValueError, KeyError, DepthError):
        yield False


def read_records(folder: Path, start: int = 0, count: int | None = None) -> Iterator[FrameRecord]:
    """Read the records of ``count`` frames from ``start`` on, in order, as far as they are done.

    Raises BadImage: a file is damaged.
    """
    indices = itertools.count(start) if count is None else range(start, start + count)
    for index in indices:
        try:
            with frame_path(folder, index).open("rb") as file:
                line = file.readline(_LONGEST_RECORD)
        except FileNotFoundError:
            return
        yield decode_record(line)


def read_frame(folder: Path, index: int, rig: RectifiedRig | None) -> JobFrame:
    """Read one frame. Raises OSError: it is not there; BadImage: it is damaged."""
    return decode_frame(frame_path(folder, index).read_bytes(), rig)


def read_frames(folder: Path, first: int = 0) -> Iterator[JobFrame]:
    """Read every frame that is done from ``first`` on, in order, those without a map included.

    Raises BadImage: a file is damaged.
    """
    try:
        rig = read_made(folder).rig
    except FileNotFoundError:
        return
    for path in sorted(folder.glob(f"*{SUFFIX}"))[first:]:
        try:
            yield decode_frame(path.read_bytes(), rig)
        except BadImage as error:
            raise BadImage(f"{path.name}: {error}") from None
