"""Examine an image file without decoding it: its kind, its size, and whether it is whole.

Decoders trust what a file says about itself: OpenCV allocates and fills the three gigabytes that a
chunk of a PNG of 88 bytes claims to have. So the chunks, segments and scans of a file are walked
first, and nothing reaches a decoder that claims more than it brings. The memory of a decoder is
then proportional to the bytes of the file, or for WebP, whose coder has no such limit, to the
pixels that its header states.

Sources: PNG third edition (https://www.w3.org/TR/png-3/), ITU T.81 (JPEG), RFC 9649 (WebP),
netpbm's manual (PGM and PPM).
"""

import math
import re
import struct
from dataclasses import dataclass
from enum import Enum

from vergence_proto.codec.wire import Piece
from vergence_proto.errors import BadImage, FrameTooLarge


class ImageKind(Enum):
    """The kinds of image file that are decoded."""

    PNG = "PNG"
    JPEG = "JPEG"
    WEBP = "WebP"
    NETPBM = "PGM or PPM"


@dataclass(frozen=True, slots=True)
class ImageFile:
    """An image file that is whole, as far as that shows without decoding it."""

    kind: ImageKind
    width: int
    """Width in pixels, as its header states it."""
    height: int
    """Height in pixels, as its header states it."""
    data: Piece
    """The bytes for the decoder: the file, without chunks that do not decide a pixel."""


_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START = b"\xff\xd8\xff"
_WEBP_START = re.compile(rb"RIFF....WEBP", re.DOTALL)
_NETPBM_START = re.compile(rb"P[56]\s")

# A walk takes about a microsecond per part. Encoders write parts of kilobytes.
_MOST_PARTS = 1 << 16


def image_kind(data: Piece) -> ImageKind | None:
    """Return the kind of a file that starts with ``data`` (16 bytes are enough), or None."""
    start = bytes(data[:16])
    if start.startswith(_PNG_START):
        return ImageKind.PNG
    if start.startswith(_JPEG_START):
        return ImageKind.JPEG
    if _WEBP_START.match(start):
        return ImageKind.WEBP
    return ImageKind.NETPBM if _NETPBM_START.match(start) else None


def read_image_file(
    data: Piece, expected: ImageKind | None = None, *, max_pixels: int | None = None
) -> ImageFile:
    """Examine a file, of any kind or of the ``expected`` one.

    Raises FrameTooLarge: its header states more than ``max_pixels``.
    Raises BadImage: the file is of another kind, is cut short, or its parts contradict each other.
    """
    kind = image_kind(data)
    if kind is None or expected not in (None, kind):
        wanted = expected.value if expected else ", ".join(each.value for each in ImageKind)
        start = bytes(data[:8])
        raise BadImage(f"expected a {wanted} file, got {len(data)} bytes starting {start!r}")
    file, missing = _READERS[kind](data)
    if max_pixels is not None and file.width * file.height > max_pixels:
        raise FrameTooLarge(
            f"expected at most {max_pixels} pixels per image, got {file.width}x{file.height}; "
            "the server's setting limits.max_pixels allows more"
        )
    if missing:
        raise _cut_short(kind.value, data, f"{missing} cannot be {file.width}x{file.height} pixels")
    return file


# What a walk returns: the file, and the few bytes of data that cannot fill it, in words; or "".
_Walked = tuple[ImageFile, str]

# PNG: the chunks that a decoder needs. The rest is for people and colour management, and some of it
# is compressed: eight megabytes of text take eight kilobytes.
_PNG_CHUNKS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})
_PNG_ANIMATION = frozenset({b"acTL", b"fcTL", b"fdAT"})
# Samples per pixel and allowed bits per sample, by colour type.
_PNG_COLOURS = {
    0: (1, (1, 2, 4, 8, 16)),
    2: (3, (8, 16)),
    3: (1, (1, 2, 4, 8)),
    4: (2, (8, 16)),
    6: (4, (8, 16)),
}
# Deflate encodes at most 258 bytes in two bits.
_DEFLATE_RATIO = 1032


def _png(data: Piece) -> _Walked:
    kept: list[Piece] = [data[:8]]
    at, packed, width, height, row_bits = 8, 0, 0, 0, 0
    for _ in range(_MOST_PARTS):
        if at + 12 > len(data):
            raise _cut_short("PNG", data, "its end chunk is missing")
        length = int.from_bytes(data[at : at + 4], "big")
        name, body, end = bytes(data[at + 4 : at + 8]), at + 8, at + 12 + length
        if end > len(data):
            raise _cut_short("PNG", data, f"a chunk claims {length} bytes")
        if (name == b"IHDR") != (at == 8):
            raise BadImage("expected a PNG that begins with one header")
        if name == b"IHDR":
            width, height, row_bits = _png_header(bytes(data[body : body + length]))
        elif name == b"IDAT":
            packed += length
        elif name in _PNG_ANIMATION:
            raise BadImage("expected a PNG of one image, got an animation")
        elif name not in _PNG_CHUNKS and not name[0] & 0x20:  # an unknown chunk that matters
            raise BadImage(f"expected a PNG with the standard's chunks, got one named {name!r}")
        if name in _PNG_CHUNKS:
            kept.append(data[at:end])
        at = end
        if name == b"IEND":
            break
    else:
        raise BadImage(f"expected a PNG with fewer than {_MOST_PARTS} chunks")
    missing = packed * _DEFLATE_RATIO < height * (row_bits // 8)
    whole = sum(map(len, kept)) == at
    file = ImageFile(ImageKind.PNG, width, height, data if whole else b"".join(kept))
    return file, f"{packed} bytes of data" if missing else ""


def _png_header(body: bytes) -> tuple[int, int, int]:
    """Return the width, the height and the bits of a row."""
    if len(body) != 13:
        raise BadImage(f"expected a PNG header of 13 bytes, got {len(body)}")
    width, height, depth, colour, compression, filtering, interlace = struct.unpack(
        ">IIBBBBB", body
    )
    samples, depths = _PNG_COLOURS.get(colour, (0, ()))
    if depth not in depths or compression or filtering or interlace > 1 or not width * height:
        raise BadImage(f"expected a PNG header of the standard, got {body.hex()}")
    return width, height, width * samples * depth


# JPEG: baseline, extended and progressive, Huffman coded.
_JPEG_FRAMES = frozenset({0xC0, 0xC1, 0xC2})
_JPEG_SCAN, _JPEG_END = 0xDA, 0xD9
# Tables (DHT, DQT, DRI), applications' own segments, and comments.
_JPEG_SEGMENTS = frozenset({0xC4, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE})
# In a scan, FF is followed by 00, or by a restart marker (D0 to D7).
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
# Each scan passes over the whole image, however few bytes it has. Progressive encoders write ten.
_MOST_SCANS = 32


def _jpeg(data: Piece) -> _Walked:
    at, scans, packed, width, height, blocks = 2, 0, 0, 0, 0, 0
    for _ in range(_MOST_PARTS):
        while data[at : at + 2] == b"\xff\xff":  # fill bytes may precede a marker
            at += 1
        if at + 2 > len(data):
            raise _cut_short("JPEG", data, "its end marker is missing")
        marker = data[at + 1] if data[at] == 0xFF else 0
        if marker == _JPEG_END:
            break
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        end = at + 2 + length
        if end > len(data) or at + 4 > len(data):
            raise _cut_short("JPEG", data, "its end marker is missing")
        if length < 2 or marker not in _JPEG_SEGMENTS | _JPEG_FRAMES | {_JPEG_SCAN}:
            raise BadImage(
                "expected the segments of a baseline or progressive JPEG, "
                f"got {data[at : at + 4].hex()}"
            )
        if marker in _JPEG_FRAMES:
            if width:
                raise BadImage("expected a JPEG with one frame header, got two")
            width, height, blocks = _jpeg_header(bytes(data[at + 4 : end]))
        elif marker == _JPEG_SCAN:
            scans += 1
            if not width or scans > _MOST_SCANS:
                raise BadImage(f"expected a frame header, then at most {_MOST_SCANS} scans")
            found = _JPEG_MARKER.search(data, end)
            if found is None:
                raise _cut_short("JPEG", data, "its end marker is missing")
            packed += found.start() - end
            end = found.start()
        at = end
    else:
        raise BadImage(f"expected a JPEG with fewer than {_MOST_PARTS} segments")
    if not width:
        raise BadImage(f"the JPEG of {len(data)} bytes has no frame header")
    missing = 8 * packed < blocks  # the shortest code of a block has one bit
    return ImageFile(
        ImageKind.JPEG, width, height, data
    ), f"{packed} bytes of scans" if missing else ""


def _jpeg_header(body: bytes) -> tuple[int, int, int]:
    """Return the width, the height and the number of coded blocks of 8x8 samples."""
    if len(body) < 6 or body[5] not in (1, 3, 4) or len(body) != 6 + 3 * body[5]:
        raise BadImage(f"expected a JPEG frame header, got {body[:24].hex()}")
    depth, height, width = struct.unpack(">BHH", body[:5])
    factors = [(packed >> 4, packed & 15) for packed in body[7::3]]
    if depth != 8 or not width * height or any(not 1 <= n <= 4 for pair in factors for n in pair):
        raise BadImage(f"expected a JPEG of 8 bits a sample, got the header {body[:24].hex()}")
    most_across, most_down = (max(each) for each in zip(*factors, strict=True))
    blocks = sum(
        math.ceil(width * across / (8 * most_across)) * math.ceil(height * down / (8 * most_down))
        for across, down in factors
    )
    return width, height, blocks


_WEBP_CHUNKS = frozenset({b"VP8 ", b"VP8L", b"VP8X", b"ALPH", b"ICCP", b"EXIF", b"XMP "})


def _webp(data: Piece) -> _Walked:
    stated = 8 + int.from_bytes(data[4:8], "little")
    if stated > len(data):
        raise _cut_short("WebP", data, f"it claims {stated} bytes")
    canvas: tuple[int, int] | None = None
    size: tuple[int, int] | None = None
    at = 12
    for _ in range(_MOST_PARTS):
        if at + 8 > stated:
            break
        name = bytes(data[at : at + 4])
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        body, end = at + 8, at + 8 + length
        if end > stated:
            raise _cut_short("WebP", data, f"a chunk claims {length} bytes")
        if (
            name not in _WEBP_CHUNKS
            or (name == b"VP8X" and at > 12)
            or (name[:3] == b"VP8" and size)
        ):
            raise BadImage(f"expected a WebP of one image, got a chunk {name!r} at byte {at}")
        if name == b"VP8X":
            canvas = _webp_canvas(bytes(data[body:end]))
        elif name in (b"VP8 ", b"VP8L"):
            size = _webp_size(name, bytes(data[body : min(body + 10, end)]))
        at = end + (length & 1)
    else:
        raise BadImage(f"expected a WebP with fewer than {_MOST_PARTS} chunks")
    if size is None:
        raise BadImage("expected a WebP with an image, got none")
    if canvas not in (None, size):
        raise BadImage(f"the WebP's header says {canvas}, its image is {size}")
    return ImageFile(ImageKind.WEBP, *size, data), ""


def _webp_canvas(body: bytes) -> tuple[int, int]:
    if len(body) != 10:
        raise BadImage(f"expected a WebP header of 10 bytes, got {len(body)}")
    return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")


def _webp_size(name: bytes, body: bytes) -> tuple[int, int]:
    if name == b"VP8L" and len(body) >= 5 and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if name == b"VP8 " and len(body) == 10 and body[3:6] == b"\x9d\x01\x2a":
        width, height = struct.unpack("<HH", body[6:10])
        if width & 0x3FFF and height & 0x3FFF:
            return width & 0x3FFF, height & 0x3FFF
    raise BadImage(f"expected a WebP's image, got {body.hex()}")


_NETPBM_HEADER = re.compile(
    rb"P([56])SPACE(\d{1,9})SPACE(\d{1,9})SPACE(\d{1,5})\s".replace(b"SPACE", rb"(?:\s|#[^\n]*\n)+")
)


def _netpbm(data: Piece) -> _Walked:
    found = _NETPBM_HEADER.match(bytes(data[:512]))
    if found is None:
        raise BadImage(f"expected a PGM or PPM header, got {bytes(data[:24])!r}")
    width, height, most = (int(number) for number in found.groups()[1:])
    size = width * height * (3 if found[1] == b"6" else 1) * (1 if most < 256 else 2)
    if not size or not 0 < most < 65536:
        raise BadImage(f"expected a PGM or PPM with pixels, got {width}x{height} up to {most}")
    present = len(data) - found.end()
    file = ImageFile(ImageKind.NETPBM, width, height, data)
    return file, f"{present} bytes of pixels" if present < size else ""


_READERS = {
    ImageKind.PNG: _png,
    ImageKind.JPEG: _jpeg,
    ImageKind.WEBP: _webp,
    ImageKind.NETPBM: _netpbm,
}


def _cut_short(kind: str, data: Piece, why: str) -> BadImage:
    return BadImage(f"the {kind} of {len(data)} bytes is cut short: {why}")
