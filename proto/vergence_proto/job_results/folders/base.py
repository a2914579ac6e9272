"""What every layout of a result does, and the files that all of them share."""

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vergence_proto.codec.image_files import ImageKind, image_kind
from vergence_proto.codec.images import decode_image
from vergence_proto.errors import BadShape
from vergence_proto.geometry import RectifiedRig
from vergence_proto.job_results.frame_file import JobFrame
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.jobs import JobOutput
from vergence_proto.opencv import cv2

_SUFFIXES = {
    ImageKind.PNG: ".png",
    ImageKind.JPEG: ".jpg",
    ImageKind.WEBP: ".webp",
    ImageKind.NETPBM: ".ppm",
}


class File(NamedTuple):
    """One file of a result: its name below the result's folder, and its content."""

    name: str
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class About:
    """The job that a result belongs to."""

    manifest: Mapping[str, Any]
    """What the server states about the job, as ``GET /v1/sequences/ID/manifest`` returns it."""
    rig: RectifiedRig | None
    """The rectified rig of the maps; None: no frame has a map."""
    outputs: Sequence[JobOutput]
    """What the job has kept."""


class Layout(ABC):
    """Makes the files of a result from its frames, one after the other.

    Raises BadShape: the job has not kept what the layout needs.
    """

    needs: ClassVar[Mapping[JobOutput, str]] = {}
    """The outputs that a job must have kept, and what for."""

    def __init__(self, about: About) -> None:
        self.about = about
        for output, why in self.needs.items():
            if output not in about.outputs:
                raise BadShape(
                    f"the job did not keep {output.value!r}, which is needed for {why}; submit it "
                    f"again with output={output.value}"
                )
        self._lines: list[str] = []
        self._left_out = 0

    @property
    @abstractmethod
    def kinds(self) -> Sequence[Mapping[str, Any]]:
        """The kinds of files, for the manifest: path, content, type, unit, scale, no value."""

    @abstractmethod
    def _files(self, frame: JobFrame) -> Iterator[File]:
        """Make the files of a frame that has a map."""

    def _last_files(self) -> Iterator[File]:
        """Make the files that only the whole sequence has."""
        yield from ()

    def takes(self, frame: JobFrame) -> bool:
        """Return whether the layout can hold a frame that has a map."""
        return True

    def frame(self, frame: JobFrame) -> Iterator[File]:
        """Make the files of the next frame."""
        self._lines.append(frame.record.to_json() + "\n")
        if frame.disparity is None:
            return
        if self.takes(frame):
            yield from self._files(frame)
        else:
            self._left_out += 1

    def end(self) -> Iterator[File]:
        """Make the last files, after all frames."""
        yield from self._last_files()
        manifest = {**self.about.manifest, "files": [*self.kinds]}
        manifest["frames_left_out"] = self._left_out
        yield File("manifest.json", json.dumps(manifest, indent=1).encode())
        yield File("frames.jsonl", "".join(self._lines).encode())
        if self.about.rig is not None:
            yield File("rig.json", json.dumps(dataclasses.asdict(self.about.rig)).encode())


class PosedLayout(Layout):
    """A layout for tools that need a pose of every frame; frames without one are left out."""

    def takes(self, frame: JobFrame) -> bool:
        """Return whether the frame has a pose."""
        return frame.record.world_from_left is not None


def image_suffix(image: bytes) -> str:
    """Return the suffix of the name of an image file, with its dot."""
    kind = image_kind(image)
    return ".png" if kind is None else _SUFFIXES[kind]


def left_file(name: str, frame: JobFrame) -> File:
    """Return the left image with a name that lacks its suffix."""
    assert frame.left is not None  # layouts with images need it
    return File(name + image_suffix(frame.left), frame.left)


def left_png(frame: JobFrame) -> bytes:
    """Return the left image as PNG."""
    assert frame.left is not None  # layouts with images need it
    if image_kind(frame.left) is ImageKind.PNG:
        return frame.left
    image = decode_image(frame.left)
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def numbers(values: "Sequence[float] | np.ndarray[Any, Any]") -> str:
    """Write numbers so that reading them gives the same ones."""
    return " ".join(repr(float(value)) for value in values)


def posed(record: FrameRecord) -> Any:
    """Return the pose of a frame that :class:`PosedLayout` takes."""
    assert record.world_from_left is not None
    return record.world_from_left
