import sys
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from vergence_proto.codec.planes import (
    bytes_plane_from_proto,
    bytes_plane_to_proto,
    plane_from_proto,
    plane_to_proto,
)
from vergence_proto.errors import BadImage
from vergence_proto.types import OutputFormat, Plane, PlaneEncoding
from vergence_proto.v1 import depth_pb2 as pb

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9))
VALUES = st.one_of(st.floats(-5, 5000, width=32), st.just(float("nan")))
PLANES = arrays.arrays(np.float32, SHAPES, elements=VALUES)
BYTES_PLANES = arrays.arrays(np.uint8, SHAPES)
ROUNDING = 1e-6  # of float32, some multiplications long
COMPRESSIONS = [
    pb.COMPRESSION_NONE,
    pb.COMPRESSION_DELTA_ZSTD,
    pb.COMPRESSION_DELTA_DEFLATE,
]
FORMATS = [OutputFormat(), OutputFormat(deflate=True), OutputFormat(compressed=False)]
DENOMINATORS = st.sampled_from([16, 17, 24, 32, 50, 64])


def over_the_wire(plane: Plane, output: OutputFormat) -> Plane:
    return plane_from_proto(pb.Plane.FromString(plane_to_proto(plane, output).SerializeToString()))


class TestFixedPoint:
    @given(PLANES, DENOMINATORS, st.booleans())
    def test_a_value_comes_back_within_half_a_step(
        self, plane: Plane, denominator: int, compressed: bool
    ) -> None:
        output = OutputFormat(denominator=denominator, compressed=compressed)
        back = over_the_wire(plane, output)
        step, largest = 1 / denominator, 65535 / denominator
        expected = np.minimum(plane, np.float32(largest))
        # Where the value falls on the very middle between two steps, float32 decides.
        half_low, half_high = step / 2 * (1 - ROUNDING), step / 2 * (1 + ROUNDING)
        kept = expected > half_high
        np.testing.assert_allclose(back[kept], expected[kept], rtol=ROUNDING, atol=half_high)
        # NaN, zero, and what rounds to zero, have no number on the wire.
        assert np.isnan(back[~(expected >= half_low)]).all()

    @given(PLANES, DENOMINATORS)
    def test_compression_loses_nothing(self, plane: Plane, denominator: int) -> None:
        plain = over_the_wire(plane, OutputFormat(denominator=denominator, compressed=False))
        for deflate in (False, True):
            packed = over_the_wire(plane, OutputFormat(denominator=denominator, deflate=deflate))
            np.testing.assert_array_equal(packed.view(np.uint32), plain.view(np.uint32))

    @given(arrays.arrays(np.uint16, SHAPES))
    def test_every_stored_number_survives(self, stored: NDArray[np.uint16]) -> None:
        plane = (stored / 64).astype(np.float32)
        back = over_the_wire(plane, OutputFormat())
        np.testing.assert_array_equal(np.nan_to_num(back), plane)
        np.testing.assert_array_equal(np.isnan(back), stored == 0)

    def test_infinity_saturates(self) -> None:
        plane = np.array([[np.inf, -np.inf]], np.float32)
        np.testing.assert_array_equal(
            over_the_wire(plane, OutputFormat()), [[np.float32(65535 / 64), np.nan]]
        )


class TestFloats:
    @given(PLANES)
    def test_float32_is_exact(self, plane: Plane) -> None:
        output = OutputFormat(PlaneEncoding.FLOAT32)
        np.testing.assert_array_equal(over_the_wire(plane, output), plane)

    @given(PLANES)
    def test_float16_is_the_nearest_half(self, plane: Plane) -> None:
        output = OutputFormat(PlaneEncoding.FLOAT16)
        np.testing.assert_allclose(over_the_wire(plane, output), plane, rtol=2**-11, atol=2**-25)


@given(BYTES_PLANES, st.sampled_from(COMPRESSIONS))
def test_bytes_are_exact(plane: NDArray[np.uint8], compression: pb.Compression) -> None:
    back = bytes_plane_from_proto(bytes_plane_to_proto(plane, compression=compression))
    np.testing.assert_array_equal(back, plane)


def test_the_compressed_bytes_are_those_the_proto_describes() -> None:
    """Packed by hand after the comment in depth.proto, number by number."""
    stored = [[10, 300], [9, 65535], [9, 0]]
    folded = [10 << 1, 300 << 1]  # the first row is positive: fold(n) = 2n
    folded += [1, (300 - 65535 + 65536) * 2]  # 9 - 10 = -1 to 1; 65535 - 300 wraps to -301...
    folded[3] = 2 * 301 - 1  # ...to 601
    folded += [0, 2]  # unchanged; 0 - 65535 wraps to 1
    data = zstd.compress(bytes(n % 256 for n in folded) + bytes(n // 256 for n in folded))
    message = pb.Plane(
        encoding=pb.PLANE_ENCODING_UINT16,
        compression=pb.COMPRESSION_DELTA_ZSTD,
        width=2,
        height=3,
        denominator=1,
        data=data,
    )
    np.testing.assert_array_equal(np.nan_to_num(plane_from_proto(message)), stored)


class TestDamage:
    @given(st.sampled_from(FORMATS), st.data())
    def test_a_cut_plane_is_an_error(self, output: OutputFormat, data: st.DataObject) -> None:
        message = plane_to_proto(_slope(), output)
        message.data = message.data[: data.draw(st.integers(0, len(message.data) - 1))]
        with pytest.raises(BadImage):
            plane_from_proto(message)

    @pytest.mark.parametrize("output", FORMATS, ids=["zstd", "deflate", "plain"])
    def test_bytes_too_many_are_an_error(self, output: OutputFormat) -> None:
        message = plane_to_proto(_slope(), output)
        message.data += message.data
        with pytest.raises(BadImage, match="bytes"):
            plane_from_proto(message)

    @given(st.floats(0, 1), st.integers(0, 255))
    def test_a_changed_byte_gives_a_plane_of_that_size_or_the_error(
        self, position: float, value: int
    ) -> None:
        message = plane_to_proto(_slope(), OutputFormat())
        changed = bytearray(message.data)
        changed[round(position * (len(changed) - 1))] = value
        message.data = bytes(changed)
        with suppress(BadImage):
            assert plane_from_proto(message).shape == _slope().shape

    def test_a_bomb_is_not_unpacked(self) -> None:
        message = plane_to_proto(_slope(), OutputFormat())
        message.data = zstd.compress(bytes(64 << 20))
        tracemalloc.start()
        with pytest.raises(BadImage, match="hold more"):
            plane_from_proto(message)
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak_bytes < 1 << 20

    def test_a_frame_that_lacks_its_end_is_an_error_though_all_pixels_are_there(self) -> None:
        message = plane_to_proto(_slope(), OutputFormat())
        checked = {zstd.CompressionParameter.checksum_flag.value: 1}
        whole = zstd.compress(zstd.decompress(message.data), options=checked)
        message.data = whole
        assert plane_from_proto(message).shape == _slope().shape
        message.data = whole[:-1]
        with pytest.raises(BadImage, match="one whole zstd frame"):
            plane_from_proto(message)

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            pytest.param("width", 31, id="width"),
            pytest.param("width", 0, id="no width"),
            pytest.param("denominator", 0, id="no denominator"),
            pytest.param("encoding", 99, id="unknown encoding"),
            pytest.param("encoding", pb.PLANE_ENCODING_UNSPECIFIED, id="no encoding"),
            pytest.param("encoding", pb.PLANE_ENCODING_FLOAT32, id="compressed floats"),
            pytest.param("encoding", pb.PLANE_ENCODING_UINT8, id="bytes where values belong"),
            pytest.param("compression", 99, id="unknown compression"),
            pytest.param("compression", pb.COMPRESSION_NONE, id="packed, said to be plain"),
        ],
    )
    def test_a_field_that_does_not_fit_is_an_error(self, field: str, value: int) -> None:
        message = plane_to_proto(_slope(), OutputFormat())
        setattr(message, field, value)
        with pytest.raises(BadImage):
            plane_from_proto(message)

    def test_values_where_bytes_belong_are_an_error(self) -> None:
        with pytest.raises(BadImage, match="UINT8"):
            bytes_plane_from_proto(plane_to_proto(_slope(), OutputFormat()))


def _slope() -> Plane:
    v, u = np.mgrid[:24, :32].astype(np.float32)
    slope: Plane = 3 + 0.37 * u + 0.11 * v
    return slope
