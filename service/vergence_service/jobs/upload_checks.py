"""Check untrusted files for the memory that reading them would need, before anything reads them.

An image of a few kilobytes may claim a billion pixels, and decoders trust the claim.
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path

from vergence_proto.codec.images import image_size
from vergence_proto.errors import BadImage, BadSequence, FrameTooLarge

# The largest pixel: a PNG with alpha and 16 bits per channel, or disparity in float64.
_BYTES_A_PIXEL = 8
_BEYOND_PIXELS = 1 << 20
# OpenCV reads these too, but their size is hard to find, and no data set layout needs them.
_REFUSED_KINDS = {
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"II+\0": "TIFF",
    b"MM\0+": "TIFF",
    b"GIF8": "GIF",
    b"v/1\x01": "OpenEXR",
    b"\0\0\0\x0cjP": "JPEG 2000",
    b"\xff\x4f\xff\x51": "JPEG 2000",
    b"#?R": "Radiance",
}


def checking_folder(folder: Path, *, max_pixels: int) -> Iterator[None]:
    """Check all files below ``folder``, and yield after each.

    Raises FrameTooLarge if a file or an image is too large, and BadSequence if it is damaged or of
    an unknown kind.
    """
    for path in folder.rglob("*"):
        if path.is_file():
            try:
                check_file(path, max_pixels=max_pixels)
            except (BadImage, FrameTooLarge) as error:
                kind = FrameTooLarge if isinstance(error, FrameTooLarge) else BadSequence
                raise kind(f"{path.relative_to(folder)}: {error}") from None
        yield


def check_file(path: Path, *, max_pixels: int) -> None:
    """Check one file.

    Raises FrameTooLarge if the file or its image is too large, and BadImage if the image is damaged
    or of an unknown kind.
    """
    most_bytes = max_pixels * _BYTES_A_PIXEL + _BEYOND_PIXELS
    if (size := path.stat().st_size) > most_bytes:
        raise FrameTooLarge(f"expected a file of at most {most_bytes} bytes, got {size}")
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"PK"):  # an .npz file, whatever its name
        _check_arrays(path, most_bytes)
    if start[4:8] == b"ftyp":
        raise BadImage("expected PNG, JPEG or WebP, got AVIF or a video")
    for magic, kind in _REFUSED_KINDS.items():
        if start.startswith(magic):
            raise BadImage(f"expected PNG, JPEG or WebP, got {kind}")
    if (pixels := image_size(path.read_bytes())) and pixels[0] * pixels[1] > max_pixels:
        raise FrameTooLarge(
            f"expected at most {max_pixels} pixels per image, got {pixels[0]}x{pixels[1]}"
        )


def _check_arrays(path: Path, most_bytes: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise BadImage(f"expected a readable .npz file: {error}") from None
    if unpacked > most_bytes:
        raise FrameTooLarge(f"expected at most {most_bytes} bytes of arrays, got {unpacked}")
