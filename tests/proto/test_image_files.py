"""No image file makes a decoder allocate more than the file's own size allows."""

import json
import random
import struct
import subprocess
import sys
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.support.mutants import damaged, image_files, png_bomb, png_header, png_of
from vergence_proto.codec.image_files import image_kind, read_image_file
from vergence_proto.codec.images import decode_image
from vergence_proto.errors import BadImage

FILES = image_files()
NAMES = st.sampled_from([*FILES])


@given(NAMES, st.randoms(use_true_random=False), st.integers(1, 3))
def test_a_mutant_decodes_to_the_size_in_its_header_or_is_refused(
    name: str, chance: random.Random, times: int
) -> None:
    file = FILES[name]
    for _ in range(times):
        file = damaged(file, chance)
    try:
        examined = read_image_file(file)
        decoded = decode_image(file)
    except BadImage:
        return
    assert decoded.shape == (examined.height, examined.width, 3)


# Decodes in a process with little memory; the pictures themselves need a few kilobytes.
_UNDER_A_LIMIT = """
import json, random, resource, sys
from tests.support.mutants import damaged, image_files, png_bomb
from vergence_proto.codec.image_files import read_image_file
from vergence_proto.codec.images import decode_image
from vergence_proto.errors import BadImage, FrameTooLarge

files = list(image_files().values())
for file in files:
    decode_image(file)  # every decoder has been loaded
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (96 << 20),) * 2)
chance = random.Random(5)
bombs = [png_bomb(claimed) for claimed in (0x7FFFFFFF, 0xC0000000, 200 << 20)]
taken = refused = 0
for file in [*bombs, *(damaged(chance.choice(files), chance) for _ in range(4000))]:
    try:
        read_image_file(file, max_pixels=1 << 20)
        decode_image(file)
        taken += 1
    except (BadImage, FrameTooLarge):
        refused += 1
print(json.dumps([taken, refused]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit and /proc are Linux's")
def test_mutants_are_decoded_or_refused_in_100_megabytes() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _UNDER_A_LIMIT], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    taken, refused = json.loads(done.stdout)
    assert taken > 100
    assert refused > 1000


@pytest.mark.parametrize("name", [*FILES])
def test_a_whole_file_is_read_with_its_size(name: str) -> None:
    examined = read_image_file(FILES[name])
    assert (examined.width, examined.height) == (64, 48)
    assert image_kind(FILES[name][:16]) is examined.kind


@pytest.mark.parametrize(
    "data",
    [b"", b"BM" + bytes(60), b"GIF89a" + bytes(60), b"II*\0" + bytes(60), b"P3 1 1 255 0 0 0\n"],
    ids=["nothing", "BMP", "GIF", "TIFF", "text PPM"],
)
def test_other_kinds_never_reach_a_decoder(data: bytes) -> None:
    assert image_kind(data) is None
    with pytest.raises(BadImage, match="expected a PNG, JPEG, WebP"):
        decode_image(data)


def test_a_chunk_that_claims_gigabytes_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(BadImage, match="a chunk claims 3221225472 bytes"):
        read_image_file(png_bomb(0xC0000000))


def test_a_header_that_its_data_cannot_fill_is_refused_before_it_is_decoded() -> None:
    rows = zlib.compress(bytes(1000))
    with pytest.raises(BadImage, match="cannot be 2000x2000 pixels"):
        read_image_file(png_of(png_header(2000, 2000), (b"IDAT", rows), (b"IEND", b"")))
    jpeg = bytearray(FILES["jpeg"])
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 60000, 60000)
    with pytest.raises(BadImage, match="cannot be 60000x60000 pixels"):
        read_image_file(bytes(jpeg))


def test_a_flat_picture_is_no_bomb() -> None:
    flat = np.full((1500, 2000, 3), 77, np.uint8)
    for extension in (".png", ".jpg", ".webp"):
        file = cv2.imencode(extension, flat)[1].tobytes()
        assert decode_image(file).shape == flat.shape


def test_chunks_that_decide_no_pixel_stay_away_from_the_decoder() -> None:
    rows = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
    packed = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    plain = png_of(png_header(64, 48), (b"IDAT", packed), (b"IEND", b""))
    text = b"a\0\0" + zlib.compress(bytes(8 << 20))  # eight megabytes in eight kilobytes
    noted = png_of(
        png_header(64, 48),
        (b"gAMA", struct.pack(">I", 1)),
        *[(b"zTXt", text)] * 20,
        (b"IDAT", packed),
        (b"IEND", b""),
    )
    assert read_image_file(noted).data == plain
    np.testing.assert_array_equal(decode_image(noted), rows)


@pytest.mark.parametrize(
    ("chunks", "says"),
    [
        ([(b"acTL", bytes(8))], "animation"),
        ([(b"ABCD", b"")], "standard's chunks"),
        ([png_header(64, 48)], "one header"),
    ],
    ids=["animation", "unknown and critical", "a second header"],
)
def test_other_chunks_of_a_png_are_refused(chunks: list[tuple[bytes, bytes]], says: str) -> None:
    rows = zlib.compress(bytes((3 * 64 + 1) * 48))
    file = png_of(png_header(64, 48), *chunks, (b"IDAT", rows), (b"IEND", b""))
    with pytest.raises(BadImage, match=says):
        decode_image(file)


def test_scans_without_end_are_refused() -> None:
    """Each scan of a progressive JPEG passes over the whole image, and may have a few bytes."""
    file = FILES["progressive"]
    scan = file.rindex(b"\xff\xda")
    with pytest.raises(BadImage, match="at most 32 scans"):
        read_image_file(file[:-2] + file[scan:-2] * 40 + file[-2:])


def test_arithmetic_coding_is_refused() -> None:
    file = FILES["jpeg"].replace(b"\xff\xc0", b"\xff\xc9")
    with pytest.raises(BadImage, match="baseline or progressive"):
        read_image_file(file)


def test_a_webp_must_be_one_image_of_the_size_in_its_header() -> None:
    image = FILES["webp"][12:]
    header = b"VP8X" + struct.pack("<I", 10) + bytes(4)

    def webp(*chunks: bytes) -> bytes:
        body = b"WEBP" + b"".join(chunks)
        return b"RIFF" + struct.pack("<I", len(body)) + body

    def canvas(width: int, height: int) -> bytes:
        sizes = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
        return header + sizes

    assert decode_image(webp(canvas(64, 48), image)).shape == (48, 64, 3)
    for bad in (
        webp(canvas(4000, 48), image),
        webp(image, image),
        webp(image, canvas(64, 48)),
        webp(canvas(64, 48)),
        webp(canvas(64, 48), b"ANIM" + struct.pack("<I", 6) + bytes(6), image),
    ):
        with pytest.raises(BadImage):
            decode_image(bad)


def _png(samples: NDArray[Any]) -> bytes:
    done, file = cv2.imencode(".png", samples)
    assert done
    return file.tobytes()


class TestBitDepths:
    """Samples become 8 bits; what a file holds beyond three colours is left out."""

    EIGHT = np.random.default_rng(5).integers(0, 256, (9, 7, 3), np.uint8)

    @pytest.mark.parametrize("shift", [0, 8])
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_sixteen_bits_are_read_at_either_end(self, shift: int, channels: int) -> None:
        alpha = np.full((9, 7, 1), 200, np.uint8)
        bgr = np.concatenate([self.EIGHT, alpha], axis=2)[..., :channels]
        read = decode_image(_png(np.squeeze(bgr.astype(np.uint16) << shift)))
        expected = np.repeat(bgr, 3, axis=2) if channels == 1 else bgr[..., 2::-1]
        np.testing.assert_array_equal(read, expected)

    @pytest.mark.parametrize("bits", [10, 12, 16])
    def test_more_bits_lose_the_lower_ones(self, bits: int) -> None:
        samples = np.random.default_rng(bits).integers(0, 1 << bits, (9, 7)).astype(np.uint16)
        samples[0, 0] = (1 << bits) - 1
        np.testing.assert_array_equal(decode_image(_png(samples))[..., 0], samples >> 8)

    def test_a_pgm_of_sixteen_bits(self) -> None:
        samples = (np.arange(63).reshape(9, 7) * 1000).astype(">u2")
        read = decode_image(b"P5\n7 9\n65535\n" + samples.tobytes())
        np.testing.assert_array_equal(read[..., 2], samples >> 8)
