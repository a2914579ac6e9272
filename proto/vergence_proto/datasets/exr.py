"""OpenEXR files with one value per pixel.

What renderers write most (scan lines, not compressed or by ZIP) is read here. Other kinds need the
OpenEXR package, or an OpenCV that was built with OpenEXR, which the wheels of OpenCV 5 are not.
"""

import importlib
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from vergence_proto.datasets.files import DatasetError, existing
from vergence_proto.opencv import cv2
from vergence_proto.types import Plane

_MAGIC = b"\x76\x2f\x31\x01"
_TILED_OR_DEEP = 0x1A00
_LINES_PER_BLOCK = {0: 1, 2: 1, 3: 16}  # compression: none, ZIPS, ZIP
_CHANNELS = ("R", "Y", "G")
_TYPES = {1: "<f2", 2: "<f4"}
# OpenCV's releases with OpenEXR read files only when this variable says so.
_OPENCV_SWITCH = "OPENCV_IO_ENABLE_OPENEXR"


def read_exr(path: Path) -> Plane:
    """Read the first of R, Y, G or whatever channel there is, float32 [H, W].

    Raises DatasetError: the file is missing, damaged, or of a kind that nothing here decodes.
    """
    data = existing(path, "an OpenEXR file").read_bytes()
    if not data.startswith(_MAGIC):
        raise DatasetError(f"{path}: expected OpenEXR, got a file starting {data[:4]!r}")
    try:
        plane = _own_kind(data)
    except (KeyError, IndexError, ValueError, struct.error, zlib.error) as error:
        raise DatasetError(f"{path}: a damaged OpenEXR file: {error}") from None
    return _by_library(path) if plane is None else plane


def _own_kind(data: bytes) -> Plane | None:
    """None: it is of a kind that only the libraries decode."""
    attributes, start = _header(data)
    compression = attributes["compression"][0]
    channels = _channels(attributes["channels"])
    (flags,) = struct.unpack_from("<I", data, 4)
    own = compression in _LINES_PER_BLOCK and not flags & _TILED_OR_DEEP
    if not own or any(kind not in _TYPES for _, kind in channels):
        return None
    box = struct.unpack("<4i", attributes["dataWindow"])
    return _scan_lines(data, start, box, channels, compression)


def _wanted(names: list[str]) -> str:
    return next((name for name in _CHANNELS if name in names), names[0])


def _header(data: bytes) -> tuple[dict[str, bytes], int]:
    """The attributes by name, and where the table of offsets starts."""
    attributes, at = {}, 8
    while data[at]:
        name_end = data.index(0, at)
        kind_end = data.index(0, name_end + 1)
        (size,) = struct.unpack_from("<I", data, kind_end + 1)
        attributes[data[at:name_end].decode()] = data[kind_end + 5 : kind_end + 5 + size]
        at = kind_end + 5 + size
    return attributes, at + 1


def _channels(data: bytes) -> list[tuple[str, int]]:
    """Each channel's name and type, in the order of the file."""
    channels, at = [], 0
    while data[at]:
        end = data.index(0, at)
        (kind,) = struct.unpack_from("<i", data, end + 1)
        channels.append((data[at:end].decode(), kind))
        at = end + 17
    return channels


def _scan_lines(
    data: bytes,
    start: int,
    box: tuple[int, ...],
    channels: list[tuple[str, int]],
    compression: int,
) -> Plane:
    left, top, right, bottom = box
    width, height = right - left + 1, bottom - top + 1
    names = [name for name, _ in channels]
    kinds = [np.dtype(_TYPES[kind]) for _, kind in channels]
    lines_per_block = _LINES_PER_BLOCK[compression]
    row = np.dtype([(str(k), kind, (width,)) for k, kind in enumerate(kinds)])
    plane = np.empty((height, width), np.float32)
    for block in range(-(-height // lines_per_block)):
        (at,) = struct.unpack_from("<Q", data, start + 8 * block)
        first, size = struct.unpack_from("<ii", data, at)
        lines = min(lines_per_block, bottom + 1 - first)
        packed = data[at + 8 : at + 8 + size]
        raw = packed if size == lines * row.itemsize else _unzipped(packed)
        rows = np.frombuffer(raw, row, count=lines)
        plane[first - top : first - top + lines] = rows[str(names.index(_wanted(names)))]
    return plane


def _unzipped(packed: bytes) -> bytes:
    """Inflate, then undo the two steps that come before: differences, and halves of the bytes."""
    steps = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
    steps[1:] -= 128
    halves = (np.cumsum(steps) & 255).astype(np.uint8)
    middle = (halves.size + 1) // 2
    whole = np.empty_like(halves)
    whole[0::2], whole[1::2] = halves[:middle], halves[middle:]
    return whole.tobytes()


def _by_library(path: Path) -> Plane:
    try:
        openexr: Any = importlib.import_module("OpenEXR")
    except ImportError:
        return _by_opencv(path)
    try:
        channels = openexr.File(str(path), separate_channels=True).channels()
    except (OSError, RuntimeError, ValueError) as error:
        raise DatasetError(f"{path}: a damaged OpenEXR file: {error}") from None
    return np.asarray(channels[_wanted(list(channels))].pixels, np.float32)


def _by_opencv(path: Path) -> Plane:
    before = os.environ.get(_OPENCV_SWITCH)
    os.environ[_OPENCV_SWITCH] = "1"
    try:
        decoded = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    finally:
        if before is None:
            del os.environ[_OPENCV_SWITCH]
        else:
            os.environ[_OPENCV_SWITCH] = before
    if decoded is None:
        raise DatasetError(
            f"{path}: this kind of OpenEXR file needs the OpenEXR package, which is not "
            "installed: pip install OpenEXR"
        )
    plane = np.asarray(decoded, np.float32)
    return plane if plane.ndim == 2 else plane[..., 2]  # BGR
