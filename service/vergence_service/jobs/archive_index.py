"""Parts of archives: a download that broke off continues, and no archive is kept on the disk.

An archive is encoded while it is sent, and the same job gives the same bytes each time. The index
of an archive has the size of each frame's files in it, and what follows the last frame. With it, a
part is made of the frames in it alone::

    jobs/ID/archives/TAG    a line of JSON with the sizes, then what follows the last frame
    jobs/ID/archives/TAG.mp4    a film, which is made once
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from vergence_proto.job_results.folders.base import Layout
from vergence_proto.jobs import ResultFormat
from vergence_proto.opencv import cv2
from vergence_service.jobs.archive import layout_of, zip_of, zipped_frame
from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobStatus
from vergence_service.jobs.results import read_frames


class ArchiveChanged(RuntimeError):
    """The files of a result do not give the archive that its index describes."""


@dataclass(frozen=True, slots=True)
class ArchiveIndex:
    """What an archive consists of."""

    sizes: tuple[int, ...]  # bytes of the files of each frame
    tail: bytes  # what follows the last frame: the other files and the directory

    @property
    def total(self) -> int:
        """The size of the archive in bytes."""
        return sum(self.sizes) + len(self.tail)


def archive_tag(job: Job, form: ResultFormat) -> str:
    """Return a name of the bytes of an archive: of the job, its end, and what encodes it."""
    encoders = (version("vergence"), np.__version__, cv2.__version__)
    known = repr((job.job_id, job.finished_s, form.value, encoders))
    return hashlib.sha256(known.encode()).hexdigest()[:32]


def read_index(path: Path) -> ArchiveIndex | None:
    """Read an index, or return None if there is none."""
    try:
        line, _, tail = path.read_bytes().partition(b"\n")
        return ArchiveIndex(tuple(json.loads(line)), tail)
    except (OSError, TypeError, ValueError):
        return None


def recording(status: JobStatus, folder: Path, form: ResultFormat, path: Path) -> Iterator[bytes]:
    """Make an archive in pieces, and write its index to ``path`` at the end.

    Raises BadShape before the first piece: the job has not kept what the layout needs.
    """
    return _recording(zip_of(status, folder, form), path)


def _recording(pieces: Iterator[bytes], path: Path) -> Iterator[bytes]:
    sizes: list[int] = []
    tail = b""
    for piece in pieces:  # one a frame, and one more
        sizes.append(len(piece))
        tail = piece
        yield piece
    with suppress(OSError):  # a full disk: the next download starts at its beginning
        path.parent.mkdir(exist_ok=True)
        unfinished = path.with_suffix(".new")
        unfinished.write_bytes(json.dumps(sizes[:-1]).encode() + b"\n" + tail)
        unfinished.replace(path)


def part_of(
    status: JobStatus,
    folder: Path,
    form: ResultFormat,
    index: ArchiveIndex,
    start: int,
    stop: int,
) -> Iterator[bytes]:
    """Make the bytes from ``start`` to before ``stop`` of an archive, in pieces.

    Raises BadShape before the first piece, and ArchiveChanged if the frames are others than those
    of the index.
    """
    return _part_of(layout_of(status, folder, form), folder, index, start, stop)


def _part_of(
    layout: Layout, folder: Path, index: ArchiveIndex, start: int, stop: int
) -> Iterator[bytes]:
    begin, first = 0, 0
    while first < len(index.sizes) and begin + index.sizes[first] <= start:
        begin += index.sizes[first]
        first += 1
    sizes = iter(index.sizes[first:])
    for frame in read_frames(folder, first):
        if begin >= stop:
            return
        piece = zipped_frame(layout, frame)
        if len(piece) != next(sizes, None):
            raise ArchiveChanged(f"frame {frame.record.index} has other files than before")
        yield piece[max(start - begin, 0) : stop - begin]
        begin += len(piece)
    yield index.tail[max(start - begin, 0) : max(stop - begin, 0)]
