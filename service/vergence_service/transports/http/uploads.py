"""What clients upload, received on disk: an archive, or the images and the calibration of a form.

Bytes are counted as they come and never held in memory. Whatever is refused or breaks off leaves
nothing behind but the folder that it was received in, which is the caller's to remove.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import Request
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError
from starlette.requests import ClientDisconnect

from vergence_proto.errors import BadSequence, UploadTooLarge
from vergence_service.jobs.archives import ArchiveLimits, unpack
from vergence_service.transports.http.forms import FormWriter, Part

FORM_TYPE = "multipart/form-data"
ARCHIVE_TYPES = (
    "application/zip",
    "application/x-zip-compressed",
    "application/x-tar",
    "application/gzip",
    "application/x-gtar",
    "application/x-xz",
    "application/x-bzip2",
    "application/octet-stream",
)
_LARGEST_JSON = 32 << 20
_EXTENSIONS = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpg", b"RIFF": "webp"}


@dataclass(frozen=True, slots=True, kw_only=True)
class UploadLimits:
    max_bytes: int
    idle_s: float  # without a byte, until the upload is given up
    archive: ArchiveLimits


class Calibration(BaseModel):
    """A rectified rig, as in calib.json; lengths in pixels and metres."""

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


class SequenceForm(BaseModel):
    """What goes with the images of a form."""

    model_config = ConfigDict(extra="forbid")

    calibration: Calibration
    poses: list[Annotated[list[FiniteFloat], Field(min_length=12, max_length=12)]] | None = Field(
        default=None,
        description="of each frame, 3x4 camera-to-world row by row: left camera, OpenCV axes, m",
    )


def client_of(request: Request) -> str:
    """The address that a request comes from."""
    return request.client.host if request.client else ""


def media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def receive_sequence(request: Request, folder: Path, limits: UploadLimits) -> None:
    """Fill ``folder``/input from the body of a request. Raises BadSequence, UploadTooLarge."""
    kind = media_type(request)
    if kind == FORM_TYPE:
        parts = await receive_form(request, folder, limits)
        await asyncio.to_thread(_sequence_of_parts, parts, folder, limits)
    elif kind in ARCHIVE_TYPES:
        archive = folder / "archive"
        with archive.open("wb") as file:
            async for chunk in _chunks(request, limits):
                await asyncio.to_thread(file.write, chunk)
        await asyncio.to_thread(_unpacked, archive, folder, limits)
    else:
        raise BadSequence(
            f"expected a body of {FORM_TYPE} or {', '.join(ARCHIVE_TYPES)}, got {kind!r}"
        )


async def receive_form(request: Request, folder: Path, limits: UploadLimits) -> list[Part]:
    """Every part of the form as a file in ``folder``. Raises BadSequence, UploadTooLarge."""
    parts = folder / "parts"
    await asyncio.to_thread(parts.mkdir)
    writer = FormWriter(request.headers["content-type"], parts, max_parts=limits.archive.max_files)
    try:
        async for chunk in _chunks(request, limits):
            await asyncio.to_thread(writer.write, chunk)
        return writer.finish()
    finally:
        writer.close()


async def _chunks(request: Request, limits: UploadLimits) -> AsyncIterator[bytes]:
    too_large = UploadTooLarge(f"expected an upload of at most {limits.max_bytes} bytes")
    if int(request.headers.get("content-length", 0)) > limits.max_bytes:
        raise too_large
    received = 0
    stream = aiter(request.stream())
    while True:
        try:
            async with asyncio.timeout(limits.idle_s):
                chunk = await anext(stream, None)
        except TimeoutError:
            raise BadSequence(
                f"the upload stopped for {limits.idle_s:g} s after {received} bytes"
            ) from None
        except ClientDisconnect:  # nobody will read this but the log of whoever wraps the client
            raise BadSequence(f"the upload broke off after {received} bytes") from None
        if chunk is None:
            return
        received += len(chunk)
        if received > limits.max_bytes:
            raise too_large
        yield chunk


def _unpacked(archive: Path, folder: Path, limits: UploadLimits) -> None:
    target = folder / "input"
    target.mkdir()
    unpack(archive, target, limits.archive)
    archive.unlink()


def _sequence_of_parts(parts: Sequence[Part], folder: Path, limits: UploadLimits) -> None:
    by_name: dict[str, list[Path]] = {}
    for part in parts:
        by_name.setdefault(part.name, []).append(part.path)
    names = set(by_name)
    if names == {"archive"} and len(parts) == 1:
        _unpacked(parts[0].path, folder, limits)
    elif names == {"left", "right", "sequence"} and len(by_name["sequence"]) == 1:
        _write_layout(folder / "input", by_name["left"], by_name["right"], by_name["sequence"][0])
    else:
        raise BadSequence(
            "expected a form with one file 'archive', or with one JSON 'sequence' and as many "
            f"images 'left' as 'right', got {sorted(names)}"
        )
    for leftover in (folder / "parts").iterdir():
        leftover.unlink()


def _write_layout(
    target: Path, left: Sequence[Path], right: Sequence[Path], sequence: Path
) -> None:
    """As a folder of the project's own layout."""
    form = _sequence_form(sequence)
    counts = {"left": len(left), "right": len(right)}
    if form.poses is not None:
        counts["poses"] = len(form.poses)
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise BadSequence(f"expected as many of each, got {told}")
    target.mkdir()
    calibration = form.calibration.model_dump(exclude_none=True)
    (target / "calib.json").write_text(json.dumps(calibration), "utf-8")
    if form.poses is not None:
        lines = (" ".join(map(repr, pose)) for pose in form.poses)
        (target / "poses.txt").write_text("\n".join(lines), "utf-8")
    for side, images in (("left", left), ("right", right)):
        for index, image in enumerate(images):
            image.rename(target / f"frame_{index:04d}_{side}.{_extension(image)}")


def _sequence_form(path: Path) -> SequenceForm:
    if path.stat().st_size > _LARGEST_JSON:
        raise UploadTooLarge(f"expected a JSON 'sequence' of at most {_LARGEST_JSON} bytes")
    try:
        return SequenceForm.model_validate_json(path.read_bytes())
    except ValidationError as error:
        told = "; ".join(
            f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()
        )
        raise BadSequence(f"the JSON 'sequence': {told}") from None


def _extension(image: Path) -> str:
    with image.open("rb") as file:
        start = file.read(4)
    for magic, extension in _EXTENSIONS.items():
        if start.startswith(magic):
            return extension
    raise BadSequence(f"expected PNG, JPEG or WebP images, got a file starting {start!r}")
