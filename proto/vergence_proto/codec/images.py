"""Camera images: conversion between RGB and raw rows, JPEG or PNG files.

OpenCV does not report every damage: for half a JPEG, some releases raise an error and others return
a grey lower half. An image may also be larger than its sender stated. So the end of the file and
the size in its header are checked here, before a pixel is decoded.
"""

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.wire import Piece, delimited
from vergence_proto.errors import BadImage
from vergence_proto.types import Image, ImageEncoding
from vergence_proto.v1 import depth_pb2 as pb

_CHANNELS = {pb.IMAGE_ENCODING_MONO8: 1, pb.IMAGE_ENCODING_RGB8: 3}

# The rig describes the rows as they are stored, so a hint to viewers to rotate them is ignored.
_DECODE_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"  # the last chunk's name and checksum
_JPEG_START = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
# Start-of-frame markers: C0 to CF except DHT (C4), JPG (C8) and DAC (CC).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers without a length: TEM and the restarts, start and end of image.
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xDA)})


def image_to_wire(
    image: NDArray[np.uint8], encoding: ImageEncoding, *, jpeg_quality: int = 90
) -> list[Piece]:
    """Encode uint8 [H, W, 3] RGB or [H, W] grey as the pieces of a ``pb.Image``.

    A piece may be a view of the image itself.
    Raises BadImage: the image has another type or shape, is empty, or does not fit the encoding.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise BadImage(
            f"expected uint8 [H, W, 3] RGB or [H, W] grey, got {image.dtype} {list(image.shape)}"
        )
    height, width = image.shape[:2]
    if height == 0 or width == 0:
        raise BadImage(f"expected an image, got {width}x{height} pixels")
    match encoding:
        case ImageEncoding.RAW:
            kind = pb.IMAGE_ENCODING_MONO8 if image.ndim == 2 else pb.IMAGE_ENCODING_RGB8
            data: Piece = np.ascontiguousarray(image).data.cast("B")
        case ImageEncoding.JPEG:
            kind = pb.IMAGE_ENCODING_JPEG
            data = _encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
        case ImageEncoding.PNG:
            kind = pb.IMAGE_ENCODING_PNG
            data = _encoded(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1])  # 1: the quickest
    header = pb.Image(encoding=kind, width=width, height=height)
    return [header.SerializeToString(), *delimited(pb.Image.DATA_FIELD_NUMBER, data)]


def image_from_proto(message: pb.Image, data: bytes | None = None) -> Image:
    """Decode to uint8 [H, W, 3] RGB, possibly a read-only view of ``data``.

    A grey image gets three equal channels. ``data`` is ``message.data``, if the caller has read it
    already; every access copies it.
    Raises BadImage: the bytes are not a whole image of the stated encoding and size.
    """
    data = message.data if data is None else data
    stated = (message.width, message.height)
    if 0 in stated:
        raise BadImage(f"expected a size in pixels, got {message.width}x{message.height}")
    if message.encoding in _CHANNELS:
        return _from_raw(message, data)
    if message.encoding == pb.IMAGE_ENCODING_JPEG:
        name, size = "JPEG", _jpeg_size(data)
    elif message.encoding == pb.IMAGE_ENCODING_PNG:
        name, size = "PNG", _png_size(data)
    else:
        raise BadImage(f"expected an image encoding of depth.proto, got {message.encoding}")
    if size != stated:
        raise BadImage(
            f"the message says {stated[0]}x{stated[1]}, its {name} is {size[0]}x{size[1]}"
        )
    return decode_image(data)


def decode_image(data: bytes) -> Image:
    """Decode an image file of any format that OpenCV reads to uint8 [H, W, 3] RGB.

    Raises BadImage: the bytes are no image file, or one that is cut short or damaged.
    """
    size = image_size(data)
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), _DECODE_FLAGS) if data else None
    except cv2.error as error:
        raise BadImage(f"the image does not decode: {error.err}") from None
    if decoded is None or (size and decoded.shape[1::-1] != size):
        raise BadImage(f"{len(data)} bytes starting {data[:8]!r} are no image, or a damaged one")
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB, dst=decoded), np.uint8)


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) from the header of a PNG, JPEG or WebP file, for others None.

    Raises BadImage: a PNG or JPEG is cut short or has no header.
    """
    if data.startswith(_JPEG_START):
        return _jpeg_size(data)
    if data.startswith(_PNG_SIGNATURE):
        return _png_size(data)
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return _webp_size(data)
    return None


def _from_raw(message: pb.Image, data: bytes) -> Image:
    channels = _CHANNELS[message.encoding]
    expected = message.width * message.height * channels
    if len(data) != expected:
        raise BadImage(
            f"{message.width}x{message.height} with {channels} byte(s) a pixel is {expected} bytes "
            f"without row padding, got {len(data)}"
        )
    pixels = np.frombuffer(data, np.uint8).reshape(message.height, message.width, channels)
    return pixels if channels == 3 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), "u1")


def _encoded(image: NDArray[np.uint8], extension: str, options: list[int]) -> bytes:
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, file = cv2.imencode(extension, pixels, options)
    if not done:
        raise BadImage(f"{image.shape[1]}x{image.shape[0]} does not fit a {extension} file")
    return file.tobytes()


def _png_size(data: bytes) -> tuple[int, int]:
    if not data.startswith(_PNG_SIGNATURE) or data[12:16] != b"IHDR" or len(data) < 33:
        raise BadImage(f"expected a PNG file, got {len(data)} bytes starting {data[:8]!r}")
    if _PNG_END not in data[-64:]:  # some writers pad the end
        raise BadImage(f"the PNG of {len(data)} bytes is cut short: its end chunk is missing")
    width, height = struct.unpack(">II", data[16:24])
    return width, height


def _webp_size(data: bytes) -> tuple[int, int] | None:
    match data[12:16]:
        case b"VP8X":
            return (
                1 + int.from_bytes(data[24:27], "little"),
                1 + int.from_bytes(data[27:30], "little"),
            )
        case b"VP8L":
            bits = int.from_bytes(data[21:25], "little")
            return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        case b"VP8 ":
            width, height = struct.unpack("<HH", data[26:30].ljust(4, b"\0"))
            return width & 0x3FFF, height & 0x3FFF
    return None


def _jpeg_size(data: bytes) -> tuple[int, int]:
    if not data.startswith(_JPEG_START):
        raise BadImage(f"expected a JPEG file, got {len(data)} bytes starting {data[:8]!r}")
    if _JPEG_END not in data[-64:]:  # some cameras pad the end
        raise BadImage(f"the JPEG of {len(data)} bytes is cut short: its end marker is missing")
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        if marker == 0xFF:  # fill bytes may precede a marker
            at += 1
        elif marker in _JPEG_BARE:
            at += 2
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise BadImage(f"the JPEG of {len(data)} bytes has no frame header")
