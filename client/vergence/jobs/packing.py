"""What a job is made of: an archive, a folder, a source of a data set, or arrays.

A folder travels as a tar that is made while it is sent. The same files give the same bytes, so an
upload has a digest before it is sent.
"""

import asyncio
import hashlib
import io
import json
import tarfile
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vergence_proto.errors import BadSequence
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.opencv import cv2

ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".txz", ".tar.bz2", ".tbz2")
_CHUNK = 1 << 20
_BLOCK = 512
_END = bytes(2 * _BLOCK)
_LOST = " ".join(["nan"] * 12)  # as trackers write it
_OWN = "vergence"


@dataclass(frozen=True, slots=True)
class Upload:
    """One sequence to send."""

    path: Path  # an archive, or a folder
    source: str | None = None  # KIND:PATH inside it; None: the server finds it

    @property
    def is_archive(self) -> bool:
        return self.path.is_file()

    def size(self) -> int:
        """Return the number of bytes to send. Raises OSError."""
        if self.is_archive:
            return self.path.stat().st_size
        return sum(len(head) + _padded(size) for head, _, size in self._members()) + len(_END)

    def digest(self) -> str:
        """Return the SHA-256 of what is sent, in hex. Raises OSError."""
        digest = hashlib.sha256()
        for chunk in self.chunks_now():
            digest.update(chunk)
        return digest.hexdigest()

    async def chunks(self, start: int = 0) -> AsyncIterator[bytes]:
        """Yield what is sent, from byte ``start`` on. Raises OSError."""
        chunks = self.chunks_now(start)
        while chunk := await asyncio.to_thread(next, chunks, b""):
            yield chunk

    def chunks_now(self, start: int = 0) -> Iterator[bytes]:
        """Yield what is sent, from byte ``start`` on, in this thread. Raises OSError."""
        at = 0
        for head, path, size in ((b"", self.path, None),) if self.is_archive else self._members():
            length = path.stat().st_size if size is None else size
            padding = 0 if size is None else _padded(size) - size
            whole = len(head) + length + padding
            if at + whole > start:
                yield from _from(_member(head, path, length, padding), max(start - at, 0))
            at += whole
        if not self.is_archive:
            yield _END[max(start - at, 0) :]

    def _members(self) -> Iterator[tuple[bytes, Path, int]]:
        from vergence_proto.datasets.listing import found

        for path in found(self.path, "*"):
            if path.is_file():
                info = tarfile.TarInfo(path.relative_to(self.path).as_posix())
                info.size = path.stat().st_size
                yield info.tobuf(tarfile.PAX_FORMAT), path, info.size


def find_upload(source: str | Path) -> Upload:
    """Find what a path or ``KIND:PATH`` means. Raises BadSequence: nothing, or more than one."""
    # Here, because the readers take as long to load as the rest of the client.
    from vergence_proto.datasets import DATASETS

    kind, colon, rest = str(source).partition(":")
    if colon and kind in DATASETS:
        return Upload(Path(rest.partition("?")[0]), f"{kind}:{_options(rest)}")
    path = Path(source)
    if path.is_file() and path.name.lower().endswith(ARCHIVES):
        return Upload(path)
    if not path.is_dir():
        raise BadSequence(f"{path}: expected a folder, or an archive ({' '.join(ARCHIVES)})")
    uploads = list(_sequences_in(path))
    if not uploads:
        raise BadSequence(f"{path}: no sequence in {', '.join(DATASETS)} layout")
    if len(uploads) > 1:
        named = ", ".join(str(each.source or each.path) for each in uploads[:8])
        raise BadSequence(f"{path}: more than one sequence ({named}); name one of them")
    return uploads[0]


def _sequences_in(path: Path) -> Iterator[Upload]:
    from vergence_proto.datasets import DATASETS, DatasetError, find_sources

    try:
        own = [Path(spec.partition(":")[2]) for spec in find_sources(f"{_OWN}:{path}")]
        if own:
            yield from map(Upload, own)
            return
        for kind in DATASETS:
            for spec in find_sources(f"{kind}:{path}"):
                inside = Path(spec.partition(":")[2]).relative_to(path).as_posix()
                yield Upload(path, f"{kind}:{'' if inside == '.' else inside}")
    except DatasetError as error:
        raise BadSequence(str(error)) from None


def write_arrays(folder: Path, frames: Iterable[Any], rig: RectifiedRig, fps: float) -> Upload:
    """Write pairs of arrays as a sequence.

    ``frames`` are ``(left, right)`` or ``(left, right, world_from_left)``: uint8 [H, W] or
    [H, W, 3] RGB, and a Pose, a [4, 4] matrix or None (not known). Raises BadPose.
    """
    poses, posed = [], False
    for index, (left, right, *rest) in enumerate(frames):
        pose = rest[0] if rest else None
        if pose is not None and not isinstance(pose, Pose):
            pose = Pose.from_matrix(pose)
        posed = posed or pose is not None
        numbers = [] if pose is None else pose.matrix[:3].ravel().tolist()
        poses.append(" ".join(map(repr, numbers)) or _LOST)
        for side, image in (("left", left), ("right", right)):
            pixels = np.asarray(image, np.uint8)
            stored = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
            content = cv2.imencode(".png", stored, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1]
            (folder / f"frame_{index:06d}_{side}.png").write_bytes(content.tobytes())
    calibration = {
        "width": rig.width,
        "height": rig.height,
        "fx": rig.fx,
        "fy": rig.fy,
        "cx": rig.cx_left,
        "cx_right": rig.cx_right,
        "cy": rig.cy,
        "baseline_m": rig.baseline_m,
        "fps": fps,
    }
    (folder / "calib.json").write_text(json.dumps(calibration), "utf-8")
    if posed:
        (folder / "poses.txt").write_text("\n".join(poses), "utf-8")
    return Upload(folder)


def upload_of(source: Any, stack: ExitStack, *, rig: RectifiedRig | None, fps: float) -> Upload:
    """Return what to send of a path, a spec or arrays; ``stack`` keeps temporary files.

    Raises BadSequence, and ValueError: arrays without a rig.
    """
    if isinstance(source, Upload):
        return source
    if isinstance(source, str | Path):
        return find_upload(source)
    if rig is None:
        raise ValueError("arrays need their rectified rig: submit(frames, rig=...)")
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="vergence-job-")))
    return write_arrays(folder, source, rig, fps)


def _options(rest: str) -> str:
    _, mark, options = rest.partition("?")
    return f"{mark}{options}"


def _padded(size: int) -> int:
    return -(-size // _BLOCK) * _BLOCK


def _member(head: bytes, path: Path, length: int, padding: int) -> Iterator[tuple[int, Any]]:
    """Yield the parts of a member: how long each is, and how to read it from an offset."""
    yield len(head), lambda start: [head[start:]]
    yield length, lambda start: _file_chunks(path, start, length)
    yield padding, lambda start: [bytes(padding - start)]


def _from(parts: Iterable[tuple[int, Any]], start: int) -> Iterator[bytes]:
    for length, read in parts:
        if start < length:
            yield from filter(None, read(start))
        start = max(start - length, 0)


def _file_chunks(path: Path, start: int, length: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.seek(start, io.SEEK_SET)
        left = length - start
        while left and (chunk := file.read(min(_CHUNK, left))):
            left -= len(chunk)
            yield chunk
    if left:
        raise OSError(f"{path} has become shorter while it was sent")
