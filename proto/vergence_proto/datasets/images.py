"""Image files, and the two file formats of disparity: 16-bit PNG (KITTI) and PFM."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.images import decode_image, decode_stored
from vergence_proto.datasets.files import DatasetError, existing
from vergence_proto.errors import BadImage
from vergence_proto.opencv import cv2
from vergence_proto.types import Image, Plane

# KITTI's development kit: stored = disparity * 256; 0 means no value.
_PNG_STEPS_PER_PX = np.float32(256)
# Between the words of a header may be a comment; after the last one is one line end.
_PFM_GAP = rb"(?:\s+(?:#[^\n]*\n\s*)*)"
_PFM_HEADER = re.compile(
    rb"(P[fF])"
    + _PFM_GAP
    + rb"(\d+)"
    + _PFM_GAP
    + rb"(\d+)"
    + _PFM_GAP
    + rb"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)(?:\r\n|\s)"
)


def read_image(path: Path) -> Image:
    """Read uint8 [H, W, 3] RGB; a grey image gets three equal channels.

    Raises DatasetError: the file is missing, damaged or cut short.
    """
    try:
        return decode_image(existing(path, "an image").read_bytes())
    except BadImage as error:
        raise DatasetError(f"{path}: {error}") from None


def write_disparity_png(path: Path, disparity_px: Plane) -> None:
    """Write the file that :func:`encode_disparity_png` encodes."""
    path.write_bytes(encode_disparity_png(disparity_px))


def encode_disparity_png(disparity_px: Plane) -> bytes:
    """Encode [H, W] pixels (or metres) as 16-bit PNG in KITTI's convention: times 256, 0: no value.

    NaN, 0 and negative numbers become "no value", and so do those that :func:`beyond_png` finds:
    a largest number in their place would look measured. Smaller positive values become 1/256 px.
    """
    scaled = np.fmax(disparity_px, 0) * _PNG_STEPS_PER_PX
    scaled[beyond_png(disparity_px)] = 0
    stored = np.maximum(np.rint(scaled), scaled > 0).astype(np.uint16)
    done, file = cv2.imencode(".png", stored)
    if not done:
        raise DatasetError(f"{stored.shape} does not fit a PNG")
    return file.tobytes()


def beyond_png(values: Plane) -> NDArray[np.bool_]:
    """Find the values [H, W] that a 16-bit PNG of steps of 1/256 cannot hold: above 255.998."""
    return np.asarray(values * _PNG_STEPS_PER_PX >= 65535.5)


def read_disparity_png(path: Path) -> Plane:
    """Read what :func:`write_disparity_png` writes; NaN where there is no value.

    Raises DatasetError: the file is missing, damaged, or no 16-bit grey PNG.
    """
    stored = read_stored(path)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise DatasetError(
            f"{path}: expected a 16-bit grey PNG (disparity x256), "
            f"got {stored.dtype} {list(stored.shape)}"
        )
    disparity_px = stored / _PNG_STEPS_PER_PX
    disparity_px[stored == 0] = np.nan
    return disparity_px.astype(np.float32)


def read_stored(path: Path) -> NDArray[Any]:
    """Read all channels of a PNG, PGM or PPM, with the numbers as they are stored.

    Raises DatasetError: the file is missing, damaged or cut short.
    """
    try:
        return decode_stored(existing(path, "an image").read_bytes())
    except BadImage as error:
        raise DatasetError(f"{path}: {error}") from None


def write_pfm(path: Path, values: Plane) -> None:
    """Write the file that :func:`encode_pfm` encodes."""
    path.write_bytes(encode_pfm(values))


def encode_pfm(values: Plane) -> bytes:
    """Encode float32 [H, W] as little-endian PFM; NaN becomes +inf, the format's "unknown"."""
    height, width = values.shape
    rows = np.where(np.isnan(values), np.float32(np.inf), values)[::-1].astype("<f4")
    return f"Pf\n{width} {height}\n-1.0\n".encode() + rows.tobytes()


def read_pfm(path: Path) -> Plane:
    """Read a one-channel PFM as float32 [H, W], top row first; non-finite values become NaN.

    Raises DatasetError: the file is missing, no PFM, a colour PFM, or cut short.
    """
    data = existing(path, "a PFM").read_bytes()
    header = _PFM_HEADER.match(data)
    if header is None:
        raise DatasetError(f"{path}: expected a PFM, got a file starting {data[:16]!r}")
    if header[1] == b"PF":
        raise DatasetError(f"{path}: expected a one-channel PFM (Pf), got a colour one (PF)")
    width, height, scale = int(header[2]), int(header[3]), float(header[4])
    size = 4 * width * height
    rows, tail = data[header.end() :][:size], data[header.end() + size :]
    if len(rows) != size or tail.strip(b"\0\r\n "):
        raise DatasetError(
            f"{path}: {width}x{height} needs {size} bytes after the header, "
            f"got {len(data) - header.end()}"
        )
    stored = np.frombuffer(rows, "<f4" if scale < 0 else ">f4")
    values = stored.reshape(height, width)[::-1].astype(np.float32)
    values[~np.isfinite(values)] = np.nan
    return values
