"""Damage to bytes and to image files, as an attacker or a bad link would do it."""

import random
import struct
import zlib

import cv2
import numpy as np

_ODD_LENGTHS = (0, 1, 0x7FFFFFFF, 0xC0000000, 0xFFFFFFFF)


def image_files(width: int = 64, height: int = 48) -> dict[str, bytes]:
    """One picture in each kind of file that the project decodes."""
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    picture = cv2.GaussianBlur(noise, (0, 0), 1.5)
    options = {
        "png": (".png", []),
        "jpeg": (".jpg", []),
        "progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        "webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
        "lossless webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
        "ppm": (".ppm", []),
    }
    return {
        name: cv2.imencode(kind, picture, chosen)[1].tobytes()
        for name, (kind, chosen) in options.items()
    }


def png_of(*chunks: tuple[bytes, bytes], claimed: int | None = None) -> bytes:
    """A PNG of these chunks, with right checksums. The last but one claims ``claimed`` bytes."""
    parts = [b"\x89PNG\r\n\x1a\n"]
    for index, (name, body) in enumerate(chunks):
        lies = claimed is not None and index == len(chunks) - 2
        length = claimed if lies and claimed is not None else len(body)
        parts += [struct.pack(">I", length), name, body]
        parts.append(struct.pack(">I", zlib.crc32(name + body)))
    return b"".join(parts)


def png_header(width: int, height: int) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)


def png_bomb(claimed: int, width: int = 64, height: int = 48) -> bytes:
    """A PNG of 88 bytes whose data claims to be ``claimed`` bytes long."""
    rows = zlib.compress(bytes((3 * width + 1) * height))
    return png_of(png_header(width, height), (b"IDAT", rows), (b"IEND", b""), claimed=claimed)


def damaged(data: bytes, chance: random.Random) -> bytes:
    """``data`` with one kind of damage: cut, changed, grown, shrunk, or an odd length field."""
    changed = bytearray(data)
    at = chance.randrange(len(changed) + 1)
    match chance.randrange(7):
        case 0:
            del changed[at:]
        case 1:
            for _ in range(chance.randrange(1, 40)):
                if changed:
                    changed[chance.randrange(len(changed))] = chance.randrange(256)
        case 2:
            changed[at:at] = chance.randbytes(chance.randrange(1, 200))
        case 3:
            del changed[at : at + chance.randrange(1, 400)]
        case 4:
            changed[at : at + 4] = struct.pack(
                chance.choice("<>") + "I", chance.choice(_ODD_LENGTHS)
            )
        case 5:  # a part of the file twice
            changed[at:at] = changed[at : at + chance.randrange(1, 400)]
        case 6:  # near the headers
            start = chance.randrange(min(64, len(changed)) or 1)
            changed[start : start + 4] = chance.randbytes(4)
    return bytes(changed)
