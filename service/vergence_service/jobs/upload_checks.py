"""Check untrusted files for the memory that reading them would need, before anything reads them.

An image of a few kilobytes may claim a billion pixels, and decoders trust the claim.
"""

import io
import math
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic

from vergence_proto.codec.image_files import image_kind, read_image_file
from vergence_proto.datasets.listing import IMAGES
from vergence_proto.errors import BadImage, BadSequence, FrameTooLarge

# The largest pixel: a PNG with alpha and 16 bits per channel, or disparity in float64.
_BYTES_A_PIXEL = 8
_BEYOND_PIXELS = 1 << 20
# A few bytes of these can stand for any number of pixels, and no live layout needs them.
_REFUSED_KINDS = {b"v/1\x01": "OpenEXR", b"\x89HDF": "HDF5"}
_DAMAGED = (zipfile.BadZipFile, ValueError, NotImplementedError, EOFError, RuntimeError, zlib.error)
_LARGEST_HEADER = 1 << 16
_NPY_START = b"\x93NUMPY"
_NPY_HEADERS = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}


def checking_folder(folder: Path, *, max_pixels: int) -> Iterator[str | None]:
    """Check all files below ``folder``; yield after each what is wrong with it, or None.

    A damaged image harms only its own frame. Raises FrameTooLarge if a file or an image is too
    large, and BadSequence if another file is damaged or of an unknown kind.
    """
    for path in folder.rglob("*"):
        damaged = None
        if path.is_file():
            try:
                check_file(path, max_pixels=max_pixels)
            except (BadImage, FrameTooLarge) as error:
                damaged = f"{path.relative_to(folder)}: {error}"
                if isinstance(error, FrameTooLarge):
                    raise FrameTooLarge(damaged) from None
                if path.suffix.lower() not in IMAGES:
                    raise BadSequence(damaged) from None
        yield damaged


def check_file(path: Path, *, max_pixels: int) -> None:
    """Check one file.

    Raises FrameTooLarge if the file or its image is too large, and BadImage if the image is damaged
    or of an unknown kind.
    """
    most_bytes = max_pixels * _BYTES_A_PIXEL + _BEYOND_PIXELS
    if (size := path.stat().st_size) > most_bytes:
        raise FrameTooLarge(
            f"expected a file of at most {most_bytes} bytes, got {size}; the server's setting "
            "limits.max_pixels allows more"
        )
    data = path.read_bytes()
    if image_kind(data):
        read_image_file(data, max_pixels=max_pixels)
    elif path.suffix.lower() in IMAGES:
        raise BadImage(f"expected PNG, JPEG, WebP, PGM or PPM, got a file starting {data[:8]!r}")
    elif data.startswith(b"PK"):  # an .npz file, whatever its name
        _check_arrays(path, most_bytes)
    else:
        _check_array(data[:_LARGEST_HEADER], size)
    for magic, kind in _REFUSED_KINDS.items():
        if data.startswith(magic):
            raise BadImage(f"expected no {kind} in an upload; leave the file out")


def _check_arrays(path: Path, most_bytes: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            unpacked = sum(info.file_size for info in members)
            if unpacked > most_bytes:
                raise FrameTooLarge(
                    f"expected at most {most_bytes} bytes of arrays, got {unpacked}; the server's "
                    "setting limits.max_pixels allows more"
                )
            for info in members:
                with archive.open(info) as member:
                    _check_array(member.read(_LARGEST_HEADER), info.file_size)
    except (*_DAMAGED, OSError) as error:  # also of a wrong offset
        raise BadImage(f"expected a readable .npz file: {error}") from None


def _check_array(start: bytes, size: int) -> None:
    """Check the header of an .npy file of ``size`` bytes: numpy allocates what it states."""
    if not start.startswith(_NPY_START):
        return
    file = io.BytesIO(start)
    try:
        shape, _, dtype = _NPY_HEADERS[read_magic(file)](file)
    except (ValueError, KeyError, EOFError) as error:
        raise BadImage(f"expected a readable array: {error}") from None
    if (stated := math.prod(shape) * dtype.itemsize) > size:
        raise BadImage(f"the array of {size} bytes is cut short: it claims {stated} bytes")
