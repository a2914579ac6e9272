"""Receive uploads on disk: an archive, or a form with images and a calibration.

Bytes are counted as they arrive and are never all in memory. An upload that is refused or aborted
leaves files only in the folder that the caller provides and removes.
"""

import asyncio
import hashlib
import json
import os
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import Request
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError
from starlette.requests import ClientDisconnect

from vergence_proto.codec.image_files import ImageKind, image_kind
from vergence_proto.errors import BadSequence, UploadTooLarge
from vergence_proto.text import decoded_text
from vergence_service.jobs.archive_limits import ArchiveLimits
from vergence_service.jobs.archives import ArchiveUnpacker, unpacking
from vergence_service.jobs.kept_uploads import KeptUpload
from vergence_service.process.threads import ThreadPool
from vergence_service.transports.http.bodies import body_of
from vergence_service.transports.http.forms import FormPart, FormWriter

FORM_TYPE = "multipart/form-data"
ANY_TYPE = "application/octet-stream"
ARCHIVE_TYPES = (
    "application/zip",
    "application/x-zip-compressed",
    "application/x-tar",
    "application/gzip",
    "application/x-gtar",
    "application/x-xz",
    "application/x-bzip2",
    ANY_TYPE,
)
_DIGESTED = 1 << 20
_LARGEST_JSON = 8 << 20  # its numbers take a dozen times the memory
_EXTENSIONS = {ImageKind.PNG: "png", ImageKind.JPEG: "jpg", ImageKind.WEBP: "webp"}


@dataclass(frozen=True, slots=True, kw_only=True)
class UploadLimits:
    """The limits of one upload."""

    max_bytes: int
    max_bytes_setting: str  # the setting that max_bytes follows from
    idle_s: float  # abort an upload that sends nothing for this long
    min_bytes_per_s: float  # or that is slower than this for as long
    archive: ArchiveLimits


class Calibration(BaseModel):
    """A rectified rig, as in calib.json, in pixels and metres."""

    model_config = ConfigDict(extra="forbid")

    width: Annotated[int, Field(ge=1, le=65535)]
    height: Annotated[int, Field(ge=1, le=65535)]
    fx: Annotated[FiniteFloat, Field(ge=1)]
    fy: Annotated[FiniteFloat, Field(ge=1)] | None = None
    cx: FiniteFloat
    cy: FiniteFloat
    cx_right: FiniteFloat | None = None
    baseline_m: Annotated[FiniteFloat, Field(ge=1e-4)]
    fps: Annotated[FiniteFloat, Field(gt=0)] | None = None


def _flat(pose: Any) -> Any:
    """Make one list of a matrix as lists of rows; anything else is for the validation to judge."""
    if isinstance(pose, list) and pose and all(isinstance(row, list) for row in pose):
        return [number for row in pose for number in row]
    return pose


_Numbers = list[FiniteFloat]
_PoseRow = Annotated[
    Annotated[_Numbers, Field(min_length=12, max_length=12)]
    | Annotated[_Numbers, Field(min_length=16, max_length=16)],
    BeforeValidator(_flat),
]
_LOST = " ".join(["nan"] * 12)  # as trackers write it


class SequenceForm(BaseModel):
    """The calibration and the poses of the images of a form."""

    model_config = ConfigDict(extra="forbid")

    calibration: Calibration
    poses: list[_PoseRow | None] | None = Field(
        default=None,
        description="pose of each frame: 3x4 camera-to-world matrix, row by row, flat or as lists "
        "of rows, also with the row 0 0 0 1; left camera, OpenCV axes, metres; null: not known",
    )


def client_of(request: Request) -> str:
    """Return the address that a request comes from."""
    return request.client.host if request.client else ""


def media_type(request: Request) -> str:
    """Return the media type of a body, without parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


@asynccontextmanager
async def while_connected(request: Request) -> AsyncIterator[None]:
    """Cancel the block if the client disconnects, and raise BadSequence, which it will not see.

    The body of the request must have been read.
    """
    block, gone = asyncio.current_task(), False
    assert block is not None

    async def watch() -> None:
        nonlocal gone
        while (await request.receive())["type"] != "http.disconnect":
            pass
        gone = True
        block.cancel()

    watching = asyncio.create_task(watch())
    try:
        yield
    except asyncio.CancelledError:
        if gone and block.uncancel() == 0:
            raise BadSequence("the client disconnected") from None
        raise
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def receive_sequence(
    request: Request, folder: Path, limits: UploadLimits, threads: ThreadPool
) -> str:
    """Write the sequence in the body of a request to ``folder``/input, in ``threads``.

    Returns the SHA-256 of the body.

    Raises BadSequence if the body is not an allowed form or archive or is cut off, and
    UploadTooLarge if it exceeds a limit.
    """
    kind = media_type(request)
    digest = hashlib.sha256()
    if kind == FORM_TYPE:
        parts = await receive_form(request, folder, limits, threads, digest=digest)
        async with while_connected(request):
            await threads.finish(_arranging(parts, folder, limits))
    elif kind in ARCHIVE_TYPES:
        await threads.run((folder / "input").mkdir)
        unpacker = ArchiveUnpacker(folder / "input", folder / "archive", limits.archive)
        try:
            async for chunk in body_chunks(request, limits):
                await threads.run(_take, unpacker, chunk, digest)
            async with while_connected(request):
                await threads.finish(unpacker.finishing())
        finally:
            await threads.run(unpacker.close)
    else:
        raise BadSequence(
            f"expected a body of {FORM_TYPE} or {', '.join(ARCHIVE_TYPES)}, got {kind!r}"
        )
    return digest.hexdigest()


async def receive_kept(
    request: Request, upload: KeptUpload, folder: Path, limits: UploadLimits, threads: ThreadPool
) -> str:
    """Unpack an upload that has arrived in parts to ``folder``/input; it stays where it is.

    Returns its SHA-256. Raises BadSequence if it is not complete or no archive, and UploadTooLarge
    if it exceeds a limit.
    """
    if upload.offset != upload.length:
        raise BadSequence(
            f"the upload has {upload.offset} of {upload.length} bytes; send the rest first"
        )
    archive, digest = folder / "archive", hashlib.sha256()
    await threads.run(os.link, upload.path, archive)
    async with while_connected(request):
        await threads.finish(_digesting(archive, digest))
        await threads.finish(_unpacking(archive, folder, limits))
    return digest.hexdigest()


def _digesting(path: Path, digest: "hashlib._Hash") -> Iterator[None]:
    with path.open("rb") as file:
        while chunk := file.read(_DIGESTED):
            digest.update(chunk)
            yield


async def digest_of(request: Request, limits: UploadLimits, threads: ThreadPool) -> str:
    """Receive a body without keeping it; return its SHA-256. Raises what receiving it raises."""
    digest = hashlib.sha256()
    async for chunk in body_chunks(request, limits):
        await threads.run(digest.update, chunk)
    return digest.hexdigest()


def _take(unpacker: ArchiveUnpacker, chunk: bytes, digest: "hashlib._Hash") -> None:
    unpacker.feed(chunk)
    digest.update(chunk)


async def receive_form(
    request: Request,
    folder: Path,
    limits: UploadLimits,
    threads: ThreadPool,
    *,
    digest: "hashlib._Hash | None" = None,
) -> list[FormPart]:
    """Write every part of a form to a file in ``folder``.

    Raises BadSequence if the form is damaged or cut off, and UploadTooLarge if it is too large.
    """
    parts = folder / "parts"
    await threads.run(parts.mkdir)
    writer = FormWriter(request.headers["content-type"], parts, max_parts=limits.archive.max_files)
    try:
        async for chunk in body_chunks(request, limits):
            await threads.run(writer.write, chunk)
            if digest is not None:
                await threads.run(digest.update, chunk)
        return writer.finish()
    finally:
        writer.close()


async def body_chunks(request: Request, limits: UploadLimits) -> AsyncIterator[bytes]:
    """Yield a body as it arrives. Raises UploadTooLarge, ClientTimeout and BadSequence."""
    too_large = UploadTooLarge(
        f"expected an upload of at most {limits.max_bytes} bytes; the server's setting "
        f"{limits.max_bytes_setting} allows more"
    )
    if int(request.headers.get("content-length", 0)) > limits.max_bytes:
        raise too_large
    received = 0
    chunks = body_of(request, patience_s=limits.idle_s, min_bytes_per_s=limits.min_bytes_per_s)
    try:
        async for chunk in chunks:
            received += len(chunk)
            if received > limits.max_bytes:
                raise too_large
            yield chunk
    except ClientDisconnect:  # the client is gone; only a proxy may still log this error
        raise BadSequence(f"the upload broke off after {received} bytes") from None


def _unpacking(archive: Path, folder: Path, limits: UploadLimits) -> Iterator[None]:
    target = folder / "input"
    target.mkdir()
    yield from unpacking(archive, target, limits.archive)
    archive.unlink()


def _arranging(parts: Sequence[FormPart], folder: Path, limits: UploadLimits) -> Iterator[None]:
    """Make ``folder``/input from the parts of a form, and yield after each short piece of work."""
    by_name: dict[str, list[Path]] = {}
    for part in parts:
        by_name.setdefault(part.name, []).append(part.path)
    names = set(by_name)
    if names == {"archive"} and len(parts) == 1:
        yield from _unpacking(parts[0].path, folder, limits)
    elif names == {"left", "right", "sequence"} and len(by_name["sequence"]) == 1:
        yield from _writing_layout(
            folder / "input", by_name["left"], by_name["right"], by_name["sequence"][0]
        )
    else:
        raise BadSequence(
            "expected a form with one file 'archive', or with one JSON 'sequence' and as many "
            f"images 'left' as 'right', got {sorted(names)}"
        )
    for leftover in (folder / "parts").iterdir():
        leftover.unlink()
        yield


def _writing_layout(
    target: Path, left: Sequence[Path], right: Sequence[Path], sequence: Path
) -> Iterator[None]:
    """Write a folder in the project's own layout, and yield after each image."""
    form = _sequence_form(sequence)
    counts = {"left": len(left), "right": len(right)}
    if form.poses is not None:
        counts["poses"] = len(form.poses)
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise BadSequence(f"expected as many of each, got {found}")
    target.mkdir()
    calibration = form.calibration.model_dump(exclude_none=True)
    (target / "calib.json").write_text(json.dumps(calibration), "utf-8")
    if form.poses is not None:
        lines = (_LOST if pose is None else " ".join(map(repr, pose)) for pose in form.poses)
        (target / "poses.txt").write_text("\n".join(lines), "utf-8")
    for side, images in (("left", left), ("right", right)):
        for index, image in enumerate(images):
            image.rename(target / f"frame_{index:04d}_{side}.{_extension(image)}")
            yield


def _sequence_form(path: Path) -> SequenceForm:
    if path.stat().st_size > _LARGEST_JSON:
        raise UploadTooLarge(f"expected a JSON 'sequence' of at most {_LARGEST_JSON} bytes")
    try:
        return SequenceForm.model_validate_json(decoded_text(path.read_bytes()) or "")
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()
        )
        raise BadSequence(f"the JSON 'sequence': {problems}") from None


def _extension(image: Path) -> str:
    with image.open("rb") as file:
        start = file.read(16)
    kind = image_kind(start)
    if kind not in _EXTENSIONS:
        raise BadSequence(f"expected PNG, JPEG or WebP images, got a file starting {start[:4]!r}")
    return _EXTENSIONS[kind]
