"""The results of a job: one file per frame on disk, and the formats for download.

::

    result/rig.json         the rectified rig of the maps
    result/000000.npz       offset_px float32 [H, W], NaN where there is no value; confidence uint8
                            [H, W] and sigma_px float32 [H, W] if the job asked for them

A frame that could not be read has no file.

Disparity here is the pixel offset u_left - u_right in the images, as in the files of
``vergence run`` and of the data sets. Depth takes the principal points into account.
"""

import dataclasses
import io
import json
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets import StereoSource
from vergence_proto.film import CannotFilm, FilmWriter
from vergence_proto.geometry import RectifiedRig
from vergence_proto.jobs import Output, ResultFormat
from vergence_proto.result_files import encode_maps
from vergence_proto.types import DisparityMap, Plane

_RIG = "rig.json"
_CHUNK = 1 << 20
# The colours cover the disparities of the first frame without the lowest and highest percent.
_COLOUR_RANGE_PCT = (1, 99)


class CannotEncode(RuntimeError):
    """The format cannot be written on this machine."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """The result of one frame."""

    rig: RectifiedRig
    offset_px: Plane
    confidence: NDArray[np.uint8] | None
    sigma_px: Plane | None

    @property
    def depth_m(self) -> Plane:
        zero_px = np.float32(self.rig.offset_of_zero_disparity_px)
        return self.rig.depth_from_disparity(self.offset_px - zero_px)


def start_result(folder: Path, rig: RectifiedRig) -> None:
    """Begin a result, and delete the files of earlier attempts."""
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    (folder / _RIG).write_text(json.dumps(dataclasses.asdict(rig)), "utf-8")


def write_frame(folder: Path, index: int, disparity: DisparityMap) -> None:
    """Write the file of one frame."""
    arrays: dict[str, NDArray[Any]] = {"offset_px": disparity.offset_px}
    if disparity.confidence is not None:
        arrays["confidence"] = disparity.confidence
    if disparity.sigma_px is not None:
        arrays["sigma_px"] = disparity.sigma_px
    np.savez(folder / f"{index:06d}.npz", allow_pickle=False, **arrays)


def result_bytes(sequence: StereoSource, outputs: Collection[Output]) -> int:
    """Return the disk space that the result of a sequence will need."""
    pixels = sequence.rig.left.width * sequence.rig.left.height
    bytes_a_pixel = 4 + (Output.CONFIDENCE in outputs) + 4 * (Output.SIGMA in outputs)
    return len(sequence) * pixels * bytes_a_pixel


def checking_frames(folder: Path, count: int, *, without: Collection[int] = ()) -> Iterator[bool]:
    """Yield for each of the first ``count`` files, and for the rig, if it is complete.

    A crash may have cut off the last ones. Nothing follows the first that is not complete. Frames
    of the indices ``without`` may have no file.
    """
    try:
        RectifiedRig(**json.loads((folder / _RIG).read_text("utf-8")))
        yield True
        for index in range(count):
            if index in without and not (folder / f"{index:06d}.npz").exists():
                continue
            with zipfile.ZipFile(folder / f"{index:06d}.npz") as file:
                complete = file.testzip() is None
            yield complete
            if not complete:
                return
    except (OSError, TypeError, ValueError, zipfile.BadZipFile):
        yield False


def count_frames(folder: Path) -> int:
    """Return the number of frames that have a result."""
    return sum(1 for _ in folder.glob("*.npz"))


def read_frames(folder: Path) -> Iterator[tuple[int, FrameResult]]:
    """Read index and result of each frame that has one, in order."""
    rig = RectifiedRig(**json.loads((folder / _RIG).read_text("utf-8")))
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as arrays:
            yield (
                int(path.stem),
                FrameResult(
                    rig, arrays["offset_px"], arrays.get("confidence"), arrays.get("sigma_px")
                ),
            )


def zip_of(folder: Path, form: ResultFormat, outputs: Collection[Output]) -> Iterator[bytes]:
    """Make a zip with one file per frame and output, and yield it in pieces."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w") as archive:
        archive.writestr(_RIG, (folder / _RIG).read_bytes())
        for index, frame in read_frames(folder):
            for file in encode_maps(_maps(frame, outputs), form):
                folder_of = "" if file.output is None else f"{file.output}/"
                archive.writestr(f"{folder_of}{index:04d}{file.suffix}", file.content)
            yield sink.take()
    yield sink.take()


def mp4_of(folder: Path, *, fps: float) -> Iterator[bytes]:
    """Make a film of disparity, and yield it in pieces, which are empty while frames are encoded.

    Raises CannotEncode before the first piece.
    """
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "disparity.mp4"
        for _ in _writing_mp4(path, (frame.offset_px for _, frame in read_frames(folder)), fps):
            yield b""
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                yield chunk


def _maps(frame: FrameResult, outputs: Collection[Output]) -> Mapping[Output, NDArray[Any]]:
    planes: Mapping[Output, Callable[[], NDArray[Any] | None]] = {
        Output.DISPARITY: lambda: frame.offset_px,
        Output.DEPTH: lambda: frame.depth_m,
        Output.CONFIDENCE: lambda: frame.confidence,
        Output.SIGMA: lambda: frame.sigma_px,
    }
    maps = ((output, plane()) for output, plane in planes.items() if output in outputs)
    return {output: map_ for output, map_ in maps if map_ is not None}


def _writing_mp4(path: Path, frames: Iterator[Plane], fps: float) -> Iterator[None]:
    low = high = 0.0
    try:
        film = FilmWriter(path, fps=fps)
    except CannotFilm as error:
        raise CannotEncode(f"{error}; choose another format") from None
    with film:
        for index, offset_px in enumerate(frames):
            known = np.isfinite(offset_px)
            if index == 0 and known.any():
                low, high = np.percentile(offset_px[known], _COLOUR_RANGE_PCT)
            share = (np.nan_to_num(offset_px) - low) / max(high - low, 1e-6)
            levels = (255 * np.clip(share, 0, 1)).astype(np.uint8)
            colours = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), np.uint8)
            colours[~known] = 0
            film.add(colours[..., ::-1])  # BGR to RGB
            yield


class _Sink(io.RawIOBase):
    """A file for zipfile that cannot seek. It is emptied between frames."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:  # anything with a buffer, as in the base class
        piece = bytes(data)
        self._pieces.append(piece)
        return len(piece)

    def take(self) -> bytes:
        taken = b"".join(self._pieces)
        self._pieces.clear()
        return taken
