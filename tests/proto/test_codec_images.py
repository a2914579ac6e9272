import struct
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from vergence_proto.codec import image_from_proto, image_to_wire
from vergence_proto.codec.images import decode_image
from vergence_proto.errors import BadImage
from vergence_proto.types import Image, ImageEncoding
from vergence_proto.v1 import depth_pb2 as pb

LOSSLESS = [ImageEncoding.RAW, ImageEncoding.PNG]
FILES = [ImageEncoding.JPEG, ImageEncoding.PNG]
SIDES = st.integers(1, 12)
RGB = arrays.arrays(np.uint8, st.tuples(SIDES, SIDES, st.just(3)))
GREY = arrays.arrays(np.uint8, st.tuples(SIDES, SIDES))


def smooth_image(height: int = 48, width: int = 64) -> Image:
    v, u = np.mgrid[:height, :width]
    return np.stack([2 * u + v, 255 - 3 * v, u + v], axis=-1).astype(np.uint8)


def sent(image: NDArray[np.uint8], encoding: ImageEncoding, **options: int) -> pb.Image:
    return pb.Image.FromString(b"".join(image_to_wire(image, encoding, **options)))


def over_the_wire(image: NDArray[np.uint8], encoding: ImageEncoding) -> Image:
    return image_from_proto(sent(image, encoding))


@pytest.mark.parametrize("encoding", LOSSLESS)
@given(image=RGB)
def test_lossless_encodings_keep_every_pixel(encoding: ImageEncoding, image: Image) -> None:
    np.testing.assert_array_equal(over_the_wire(image, encoding), image)


@pytest.mark.parametrize("encoding", LOSSLESS)
@given(grey=GREY)
def test_grey_comes_back_as_rgb(encoding: ImageEncoding, grey: NDArray[np.uint8]) -> None:
    back = over_the_wire(grey, encoding)
    np.testing.assert_array_equal(back, np.repeat(grey[..., None], 3, axis=2))


def test_raw_grey_travels_at_a_third_of_the_size() -> None:
    message = sent(smooth_image()[..., 0], ImageEncoding.RAW)
    assert message.encoding == pb.IMAGE_ENCODING_MONO8
    assert len(message.data) == 48 * 64


def test_jpeg_is_close_and_red_stays_red() -> None:
    image = smooth_image()
    assert np.abs(over_the_wire(image, ImageEncoding.JPEG) - image.astype(int)).mean() < 3
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 250
    assert over_the_wire(red, ImageEncoding.JPEG).mean(axis=(0, 1)) == pytest.approx(
        [250, 0, 0], abs=3
    )


def test_lower_jpeg_quality_is_smaller() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    sizes = [
        len(sent(noise, ImageEncoding.JPEG, jpeg_quality=quality).data) for quality in (30, 90)
    ]
    assert sizes[0] < sizes[1]


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(np.zeros((4, 4, 3), np.float32), id="float"),
        pytest.param(np.zeros((4, 4, 4), np.uint8), id="four channels"),
        pytest.param(np.zeros(4, np.uint8), id="one axis"),
        pytest.param(np.zeros((0, 4, 3), np.uint8), id="no rows"),
    ],
)
def test_what_is_no_image_is_refused_before_it_is_sent(image: NDArray[np.uint8]) -> None:
    with pytest.raises(BadImage, match="expected"):
        sent(image, ImageEncoding.RAW)


class TestDamage:
    @pytest.mark.parametrize("encoding", FILES)
    @given(data=st.data())
    def test_a_file_cut_anywhere_is_an_error_and_not_a_grey_half(
        self, encoding: ImageEncoding, data: st.DataObject
    ) -> None:
        message = sent(smooth_image(), encoding)
        message.data = message.data[: data.draw(st.integers(0, len(message.data) - 1))]
        with pytest.raises(BadImage, match=r"cut short|expected a"):
            image_from_proto(message)

    @pytest.mark.parametrize("encoding", FILES)
    @given(position=st.floats(0, 1), value=st.integers(0, 255))
    def test_a_changed_byte_gives_an_image_of_that_size_or_the_error(
        self, encoding: ImageEncoding, position: float, value: int
    ) -> None:
        message = sent(smooth_image(), encoding)
        changed = bytearray(message.data)
        changed[round(position * (len(changed) - 1))] = value
        message.data = bytes(changed)
        with suppress(BadImage):
            assert image_from_proto(message).shape == (48, 64, 3)

    @given(
        st.sampled_from([pb.IMAGE_ENCODING_JPEG, pb.IMAGE_ENCODING_PNG]),
        st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"]),
        st.binary(max_size=80),
        st.sampled_from([b"", b"\xff\xd9", b"IEND\xaeB`\x82"]),
    )
    def test_bytes_that_are_no_image_are_the_error(
        self, encoding: pb.ImageEncoding, start: bytes, middle: bytes, end: bytes
    ) -> None:
        message = pb.Image(encoding=encoding, width=8, height=8, data=start + middle + end)
        with pytest.raises(BadImage):
            image_from_proto(message)

    @pytest.mark.parametrize("encoding", FILES)
    def test_padding_after_the_end_is_no_damage(self, encoding: ImageEncoding) -> None:
        message = sent(smooth_image(), encoding)
        message.data += bytes(16)
        assert image_from_proto(message).shape == (48, 64, 3)

    @pytest.mark.parametrize("encoding", FILES)
    def test_one_encoding_is_not_read_as_the_other(self, encoding: ImageEncoding) -> None:
        message = sent(smooth_image(), encoding)
        jpeg, png = pb.IMAGE_ENCODING_JPEG, pb.IMAGE_ENCODING_PNG
        message.encoding = png if message.encoding == jpeg else jpeg
        with pytest.raises(BadImage, match="expected a"):
            image_from_proto(message)


class TestSize:
    @pytest.mark.parametrize("encoding", FILES)
    def test_a_file_must_be_as_large_as_the_message_says(self, encoding: ImageEncoding) -> None:
        message = sent(smooth_image(), encoding)
        message.width = 60
        with pytest.raises(BadImage, match=r"says 60x48, its (JPEG|PNG) is 64x48"):
            image_from_proto(message)

    @pytest.mark.parametrize("size", [(0, 48), (64, 0)], ids=["no width", "no height"])
    def test_a_size_is_needed(self, size: tuple[int, int]) -> None:
        message = sent(smooth_image(), ImageEncoding.RAW)
        message.width, message.height = size
        with pytest.raises(BadImage, match="expected a size"):
            image_from_proto(message)

    @given(st.integers(-1, 1).filter(bool), st.sampled_from([1, 3]))
    def test_raw_rows_must_fill_the_image_exactly(self, difference: int, channels: int) -> None:
        image = smooth_image() if channels == 3 else smooth_image()[..., 0]
        message = sent(image, ImageEncoding.RAW)
        message.data = message.data[:-1] if difference < 0 else message.data + b"\0"
        with pytest.raises(BadImage, match=f"is {48 * 64 * channels} bytes"):
            image_from_proto(message)

    def test_a_bomb_is_refused_by_its_header(self) -> None:
        """A PNG of two gigapixels in a few kilobytes, sent as 64x48."""
        rows = zlib.compress(bytes(1000))
        header = struct.pack(">IIBBBBB", 46000, 46000, 8, 2, 0, 0, 0)
        bomb = b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
        )
        message = pb.Image(encoding=pb.IMAGE_ENCODING_PNG, width=64, height=48, data=bomb)
        with pytest.raises(BadImage, match="46000x46000"):
            image_from_proto(message)

    @pytest.mark.parametrize("encoding", [pb.IMAGE_ENCODING_UNSPECIFIED, 99])
    def test_an_unknown_encoding_is_named(self, encoding: pb.ImageEncoding) -> None:
        message = sent(smooth_image(), ImageEncoding.RAW)
        message.encoding = encoding
        with pytest.raises(BadImage, match=f"got {encoding}"):
            image_from_proto(message)


def test_progressive_jpeg_is_read_too() -> None:
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    file = cv2.imencode(".jpg", smooth_image(), options)[1].tobytes()
    message = pb.Image(encoding=pb.IMAGE_ENCODING_JPEG, width=64, height=48, data=file)
    assert image_from_proto(message).shape == (48, 64, 3)


def test_tables_may_stand_before_the_frame_header() -> None:
    """Huffman tables have a marker that looks like a frame header's."""
    file = cv2.imencode(".jpg", smooth_image())[1].tobytes()
    start = file.index(b"\xff\xc4")
    length = 2 + int.from_bytes(file[start + 2 : start + 4], "big")
    tables_first = file[:2] + file[start : start + length] + file[2:]
    message = pb.Image(encoding=pb.IMAGE_ENCODING_JPEG, width=64, height=48, data=tables_first)
    assert image_from_proto(message).shape == (48, 64, 3)


def test_an_orientation_hint_does_not_turn_the_image() -> None:
    """A phone's EXIF says "rotate by 90 degrees": the rows must stay those of the calibration."""
    file = cv2.imencode(".jpg", smooth_image())[1].tobytes()
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    segment = b"Exif\0\0" + tiff
    exif = b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment
    assert decode_image(file[:2] + exif + file[2:]).shape == (48, 64, 3)
