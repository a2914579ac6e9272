"""Camera images: conversion between RGB and raw rows, JPEG or PNG files.

OpenCV does not report every damage: for half a JPEG, some releases raise an error and others return
a grey lower half. An image may also be larger than its sender stated. So
:mod:`vergence_proto.codec.image_files` examines every file before a pixel is decoded, and only this
module calls OpenCV's decoders.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.image_files import ImageFile, ImageKind, read_image_file
from vergence_proto.codec.wire import Piece, delimited
from vergence_proto.errors import BadImage
from vergence_proto.opencv import cv2
from vergence_proto.types import Image, ImageEncoding
from vergence_proto.v1 import depth_pb2 as pb

_CHANNELS = {pb.IMAGE_ENCODING_MONO8: 1, pb.IMAGE_ENCODING_RGB8: 3}

_OUT_OF_MEMORY = -4  # cv::Error::StsNoMem

_FILE_KINDS = {
    pb.IMAGE_ENCODING_JPEG: ImageKind.JPEG,
    pb.IMAGE_ENCODING_PNG: ImageKind.PNG,
}

_FILE_ENCODINGS = {kind: encoding for encoding, kind in _FILE_KINDS.items()}


def image_to_wire(
    image: NDArray[np.uint8] | bytes, encoding: ImageEncoding, *, jpeg_quality: int = 90
) -> list[Piece]:
    """Encode uint8 [H, W, 3] RGB or [H, W] grey as the pieces of a ``pb.Image``.

    Bytes are a JPEG or PNG file and travel as they are. A piece may be a view of the image itself.
    Raises BadImage: the image has another type or shape, is empty, or does not fit the encoding;
    or the file is neither JPEG nor PNG, or cut short.
    """
    if isinstance(image, bytes):
        file = camera_file(image)
        header = pb.Image(encoding=_FILE_ENCODINGS[file.kind], width=file.width, height=file.height)
        return [header.SerializeToString(), *delimited(pb.Image.DATA_FIELD_NUMBER, image)]
    height, width = check_image(image).shape[:2]
    match encoding:
        case ImageEncoding.RAW:
            kind = pb.IMAGE_ENCODING_MONO8 if image.ndim == 2 else pb.IMAGE_ENCODING_RGB8
            data: Piece = np.ascontiguousarray(image).data.cast("B")
        case ImageEncoding.JPEG:
            kind = pb.IMAGE_ENCODING_JPEG
            data = encode_jpeg(image, jpeg_quality)
        case ImageEncoding.PNG:
            kind = pb.IMAGE_ENCODING_PNG
            data = _encoded(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1])  # 1: the quickest
    header = pb.Image(encoding=kind, width=width, height=height)
    return [header.SerializeToString(), *delimited(pb.Image.DATA_FIELD_NUMBER, data)]


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode uint8 [H, W, 3] RGB or [H, W] grey. Raises BadImage: a JPEG cannot be so large."""
    return _encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def camera_file(data: bytes) -> ImageFile:
    """Examine a camera's own file. Raises BadImage: it is neither JPEG nor PNG, or cut short."""
    file = read_image_file(data)
    if file.kind not in _FILE_ENCODINGS:
        raise BadImage(f"expected the bytes of a JPEG or PNG file, got {file.kind.value}")
    return file


def check_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image unchanged.

    Raises BadImage: it is not uint8 [H, W, 3] or [H, W], or it is empty.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise BadImage(
            f"expected uint8 [H, W, 3] RGB or [H, W] grey, got {image.dtype} {list(image.shape)}"
        )
    height, width = image.shape[:2]
    if height == 0 or width == 0:
        raise BadImage(f"expected an image, got {width}x{height} pixels")
    return image


def image_from_proto(message: pb.Image, data: Piece | None = None) -> Image:
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
    kind = _FILE_KINDS.get(message.encoding)
    if kind is None:
        raise BadImage(f"expected an image encoding of depth.proto, got {message.encoding}")
    file = read_image_file(data, kind)
    if (file.width, file.height) != stated:
        raise BadImage(
            f"the message says {stated[0]}x{stated[1]}, its {kind.value} is "
            f"{file.width}x{file.height}"
        )
    return _as_rgb(_decoded(file, _as_colour()))


def decode_image(data: Piece) -> Image:
    """Decode a PNG, JPEG, WebP, PGM or PPM file to uint8 [H, W, 3] RGB.

    Raises BadImage: the bytes are no image file, or one that is cut short or damaged.
    """
    return _as_rgb(_decoded(read_image_file(data), _as_colour()))


def decode_stored(data: Piece) -> NDArray[Any]:
    """Decode an image file to the numbers that it stores: [H, W] or [H, W, C], colours as BGR.

    Raises BadImage: the bytes are no image file, or one that is cut short or damaged.
    """
    return _decoded(read_image_file(data), cv2.IMREAD_UNCHANGED)


def _as_colour() -> int:
    # The rig describes the rows as they are stored, so a hint to viewers to rotate them is ignored.
    return cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def _decoded(file: ImageFile, flags: int) -> NDArray[Any]:
    try:
        decoded = cv2.imdecode(np.frombuffer(file.data, np.uint8), flags)
    except cv2.error as error:
        if error.code == _OUT_OF_MEMORY:
            raise MemoryError(f"{file.width}x{file.height} pixels") from None
        raise BadImage(f"the {file.kind.value} does not decode: {error.err}") from None
    if decoded is None or decoded.shape[1::-1] != (file.width, file.height):
        raise BadImage(
            f"the {file.kind.value} of {len(file.data)} bytes is damaged: it does not decode to "
            f"{file.width}x{file.height} pixels"
        )
    return np.asarray(decoded)


def _as_rgb(decoded: NDArray[Any]) -> Image:
    if decoded.dtype == np.uint16:
        # The upper bits of each sample. A camera of 8 bits may be stored in 16, at the lower end.
        decoded = (decoded >> 8 if decoded.max() > 255 else decoded).astype(np.uint8)
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB, dst=decoded), np.uint8)


def _from_raw(message: pb.Image, data: Piece) -> Image:
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
