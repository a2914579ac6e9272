"""Result planes: float32 [H, W] to fixed point or IEEE bytes, and back.

UINT16 stores round(value * denominator) and 0 for "no value". Compression is lossless: differences
from the row above (modulo 2^16), folded to small unsigned numbers (0 -1 1 -2 2 to 0 1 2 3 4), all
low bytes before all high ones, one zstd frame.

On 12 true 640x480 maps of path-traced rooms that is 47 KiB of 600, packed in 0.9 ms and unpacked in
0.8 ms, for 2 MB of install; horizontal differences without the fold took 63 KiB, 16-bit PNG 66 KiB
and 5.1 ms, imagecodecs' delta + bitshuffle + zstd 77 KiB and 82 MB, blosc2's bitshuffle + zstd
101 KiB and 55 MB (one core of two; ``python tests/benchmarks/codec_size.py --data DIR``).
"""

import itertools
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadImage, BadShape
from vergence_proto.types import OutputFormat, Plane, PlaneEncoding
from vergence_proto.v1 import depth_pb2 as pb

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Stored = NDArray[Any]  # [H, W] of a type that only the message knows

_LARGEST = np.float32(np.iinfo(np.uint16).max)
_ZSTD_LEVEL = 1  # level 3 gains 3 % and costs up to three times the time
_WIRE_TYPES: dict[int, np.dtype[Any]] = {
    pb.PLANE_ENCODING_UINT8: np.dtype("u1"),
    pb.PLANE_ENCODING_UINT16: np.dtype("<u2"),
    pb.PLANE_ENCODING_FLOAT16: np.dtype("<f2"),
    pb.PLANE_ENCODING_FLOAT32: np.dtype("<f4"),
}


def plane_to_proto(plane: Plane, output: OutputFormat, *, into: pb.Plane | None = None) -> pb.Plane:
    """Encode float32 [H, W], NaN where there is no value, as ``output`` says.

    UINT16 has no zero and no negative number: what is below half a step becomes "no value". Above
    65535 / denominator it saturates. ``into`` is a field of a larger message, to save a copy.
    """
    match output.encoding:
        case PlaneEncoding.UINT16:
            kind = pb.PLANE_ENCODING_UINT16
            stored: Stored = _fixed_point(plane, output.denominator)
        case PlaneEncoding.FLOAT16:
            kind = pb.PLANE_ENCODING_FLOAT16
            stored = plane.astype(_WIRE_TYPES[kind])
        case PlaneEncoding.FLOAT32:
            kind = pb.PLANE_ENCODING_FLOAT32
            stored = plane.astype(_WIRE_TYPES[kind], copy=False)
    message = _stored_to_proto(stored, kind, compressed=output.compressed, into=into)
    if kind == pb.PLANE_ENCODING_UINT16:
        message.denominator = output.denominator
    return message


def bytes_plane_to_proto(
    plane: NDArray[np.uint8], *, compressed: bool, into: pb.Plane | None = None
) -> pb.Plane:
    """Encode uint8 [H, W]; ``into`` is a field of a larger message, to save a copy."""
    return _stored_to_proto(plane, pb.PLANE_ENCODING_UINT8, compressed=compressed, into=into)


def plane_from_proto(message: pb.Plane) -> Plane:
    """Decode to float32 [H, W], NaN where there is no value.

    Raises BadImage: bytes that are not a whole plane of the stated encoding, compression and size.
    """
    if message.encoding == pb.PLANE_ENCODING_UINT8:
        raise BadImage("expected a plane of values, got one of UINT8")
    stored = _stored(message)
    if message.encoding != pb.PLANE_ENCODING_UINT16:
        return stored.astype(np.float32)
    if message.denominator == 0:
        raise BadImage("a UINT16 plane needs a denominator above 0")
    values: Plane = np.divide(stored, message.denominator, dtype=np.float32)
    values[stored == 0] = np.nan
    return values


def bytes_plane_from_proto(message: pb.Plane) -> NDArray[np.uint8]:
    """Decode uint8 [H, W]. Raises BadImage: as :func:`plane_from_proto`."""
    if message.encoding != pb.PLANE_ENCODING_UINT8:
        raise BadImage(f"expected a UINT8 plane, got encoding {message.encoding}")
    return _stored(message).astype(np.uint8)


def check_denominator(denominator: int) -> int:
    """Raises BadShape: out of 16 to 64."""
    if not 16 <= denominator <= 64:
        raise BadShape(f"expected a denominator of 16 to 64, got {denominator}")
    return denominator


def _fixed_point(plane: Plane, denominator: int) -> NDArray[np.uint16]:
    scaled = np.multiply(plane, np.float32(denominator))
    np.fmax(scaled, 0, out=scaled)  # of NaN and a number, fmax takes the number
    np.minimum(scaled, _LARGEST, out=scaled)
    np.rint(scaled, out=scaled)
    return scaled.astype("<u2")


def _stored_to_proto(
    stored: Stored, kind: pb.PlaneEncoding, *, compressed: bool, into: pb.Plane | None
) -> pb.Plane:
    compressed = compressed and stored.dtype.kind == "u"  # of no use to floating point
    message = pb.Plane() if into is None else into
    message.encoding = kind
    message.compression = pb.COMPRESSION_DELTA_ZSTD if compressed else pb.COMPRESSION_NONE
    message.height, message.width = stored.shape
    message.data = compress_plane(stored) if compressed else stored.tobytes()
    return message


def _stored(message: pb.Plane) -> Stored:
    if message.encoding not in _WIRE_TYPES:
        raise BadImage(f"expected a plane encoding of depth.proto, got {message.encoding}")
    dtype = _WIRE_TYPES[message.encoding]
    data = message.data  # every access copies
    shape = message.height, message.width
    size = message.height * message.width * dtype.itemsize
    if size == 0:
        raise BadImage(f"expected a size in pixels, got {message.width}x{message.height}")
    if message.compression == pb.COMPRESSION_DELTA_ZSTD:
        if dtype.kind != "u":
            raise BadImage("only UINT16 and UINT8 planes can be compressed")
        return decompress_plane(data, size, shape, dtype)
    if message.compression not in (pb.COMPRESSION_NONE, pb.COMPRESSION_UNSPECIFIED):
        raise BadImage(f"expected a compression of depth.proto, got {message.compression}")
    if len(data) != size:
        raise BadImage(
            f"a {message.width}x{message.height} plane of {dtype.name} is {size} bytes, "
            f"got {len(data)}"
        )
    plane: Stored = np.frombuffer(data, dtype).reshape(shape)
    return plane


def compress_plane(stored: Stored) -> bytes:
    delta = np.empty_like(stored)
    delta[0] = stored[0]
    np.subtract(stored[1:], stored[:-1], out=delta[1:])
    itemsize = stored.dtype.itemsize
    sign = delta.view(f"<i{itemsize}") >> (8 * itemsize - 1)  # 0 or -1
    folded = (delta << 1) ^ sign.view(delta.dtype)
    shuffled = np.empty((itemsize, *stored.shape), np.uint8)
    for byte, plane in enumerate(shuffled):
        np.copyto(plane, folded >> (8 * byte), casting="unsafe")
    return zstd.compress(shuffled.data, _ZSTD_LEVEL)


def decompress_plane(
    data: bytes, size: int, shape: tuple[int, int], dtype: np.dtype[Any]
) -> Stored:
    frame = zstd.ZstdDecompressor()
    try:
        # One byte more than is right shows too much without ever unpacking all of it.
        unpacked = frame.decompress(data, max_length=size + 1)
    except zstd.ZstdError as error:
        raise BadImage(f"the plane's zstd frame is damaged: {error}") from None
    if not frame.eof or frame.unused_data or len(unpacked) != size:
        raise BadImage(
            f"expected one whole zstd frame of {size} bytes, {len(data)} bytes hold "
            f"{'more' if len(unpacked) > size or frame.unused_data else len(unpacked)}"
        )
    shuffled = np.frombuffer(unpacked, np.uint8).reshape(dtype.itemsize, *shape)
    folded: Stored = shuffled[0].astype(dtype)
    for byte, plane in enumerate(shuffled[1:], start=1):
        folded |= plane.astype(dtype) << (8 * byte)
    stored: Stored = (folded >> 1) ^ np.negative(folded & 1)
    for above, row in itertools.pairwise(stored):  # four times as quick as accumulate on axis 0
        np.add(row, above, out=row)
    return stored
