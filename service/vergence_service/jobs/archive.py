"""Results for download: the manifest of a job, an archive in any layout, or a film."""

import dataclasses
import io
import tempfile
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vergence_proto.film import CannotFilm, FilmWriter
from vergence_proto.job_results.folders import RESULT_LAYOUTS
from vergence_proto.job_results.folders.base import Layout
from vergence_proto.job_results.frame_file import STEPS_PER_PX, JobFrame
from vergence_proto.job_results.manifest import VERSION, about_of
from vergence_proto.jobs import ResultFormat
from vergence_proto.types import Plane
from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobStatus
from vergence_service.jobs.results import read_frames, read_made

_CHUNK = 1 << 20
_FILM_FPS = 30.0  # frame rate of a film whose sequence does not state one
# The colours cover the disparities of the first frame without the lowest and highest percent.
_COLOUR_RANGE_PCT = (1, 99)


class CannotEncode(RuntimeError):
    """The format cannot be written on this machine."""


def manifest_of(status: JobStatus, folder: Path) -> dict[str, Any]:
    """Return what is known about a job, for ``manifest.json``.

    Raises FileNotFoundError: no frame is done.
    """
    job, made = status.job, read_made(folder)
    rig, rotation = made.rig, made.left_from_rectified
    return {
        "manifest": VERSION,
        "id": job.job_id,
        "name": job.name,
        "labels": dict(job.labels),
        "state": job.state.value,
        "reason": job.reason,
        "message": job.message,
        "vergence": made.vergence,
        "model": {
            "name": made.model,
            "weights_sha256": made.weights_sha256,
            "engine": made.engine,
            "provider": made.provider,
        },
        "options": {
            "output": [each.value for each in job.options.outputs],
            "iterations": job.options.iterations,
            "quality": job.options.quality.value,
            "metrics": job.options.metrics,
            "on_error": job.options.on_error.value,
        },
        "source": job.source,
        "upload_sha256": job.upload_sha256,
        "input": job.input,
        "rig": None if rig is None else dataclasses.asdict(rig),
        "left_from_rectified": None if rotation is None else rotation.rotation.tolist(),
        "axes": "OPENCV",
        "units": {"length": "m", "time": "ns", "disparity": "px of the rectified left image"},
        "precision": f"disparity and sigma are rounded to 1/{STEPS_PER_PX} px: a map equals that "
        "of a lossless live stream of the same frames, rounded to it",
        "counts": {
            "frames": job.frames,
            "done": status.frames_done,
            "failed": job.frames_failed,
            "cold": job.cold_frames,
        },
        "times": {
            "created": _time(job.created_s),
            "started": _time(job.started_s),
            "finished": _time(job.finished_s),
            "frames_per_s": status.fps,
            "source_frames_per_s": job.source_fps,
        },
        "accuracy": None if job.accuracy is None else dict(job.accuracy),
        "warnings": [{"kind": each.kind.value, "message": each.message} for each in job.warnings],
        "notes": list(job.notes),
    }


def layout_of(status: JobStatus, folder: Path, form: ResultFormat) -> Layout:
    """Return the layout of a result. Raises BadShape: the job has not kept what it needs."""
    return RESULT_LAYOUTS[form](about_of(manifest_of(status, folder)))


def zip_of(status: JobStatus, folder: Path, form: ResultFormat) -> Iterator[bytes]:
    """Make a zip in a layout, and yield the files of each frame, then the rest.

    Raises BadShape before the first piece: the job has not kept what the layout needs.
    """
    return _zipping(layout_of(status, folder, form), folder)


def _zipping(layout: Layout, folder: Path) -> Iterator[bytes]:
    sink = _Sink()
    with zipfile.ZipFile(sink, "w") as archive:
        for frame in read_frames(folder):
            for file in layout.frame(frame):
                archive.writestr(zipfile.ZipInfo(file.name), file.content)
            yield sink.take()
        for file in layout.end():
            archive.writestr(zipfile.ZipInfo(file.name), file.content)
    yield sink.take()


def zipped_frame(layout: Layout, frame: JobFrame) -> bytes:
    """Return the files of a frame as they are in any zip: without the directory at its end."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w") as archive:
        for file in layout.frame(frame):
            archive.writestr(zipfile.ZipInfo(file.name), file.content)
        return sink.take()


def write_film(job: Job, folder: Path, path: Path) -> Iterator[None]:
    """Make a film of disparity at ``path``, and yield after each frame.

    Raises CannotEncode before the first frame.
    """
    path.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        unfinished = Path(scratch) / "disparity.mp4"
        maps = (frame.disparity for frame in read_frames(folder))
        planes = (each.offset_px for each in maps if each is not None)
        yield from _writing_mp4(unfinished, planes, job.source_fps or _FILM_FPS)
        unfinished.replace(path)


def read_pieces(path: Path, start: int, stop: int) -> Iterator[bytes]:
    """Yield the bytes of a file from ``start`` to before ``stop``."""
    with path.open("rb") as file:
        file.seek(start)
        while start < stop and (chunk := file.read(min(_CHUNK, stop - start))):
            start += len(chunk)
            yield chunk


def _time(unix_s: float | None) -> str | None:
    return None if unix_s is None else datetime.fromtimestamp(unix_s, UTC).isoformat()


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
