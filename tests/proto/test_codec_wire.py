"""What is laid out by hand is what protobuf would have written."""

import pytest

from vergence_proto.codec.wire import delimited
from vergence_proto.v1 import depth_pb2 as pb


# Lengths of up to 127, 16383 and 2097151 take a byte more each.
@pytest.mark.parametrize("size", [1, 127, 128, 16383, 16384, 2097151, 2097152])
def test_a_field_is_laid_out_as_by_protobuf(size: int) -> None:
    data = bytes(size)
    image = pb.Image(data=data).SerializeToString()
    assert b"".join(delimited(pb.Image.DATA_FIELD_NUMBER, data)) == image
    parted = memoryview(image)[: size // 2], memoryview(image)[size // 2 :]
    right = pb.Frame(right=pb.Image(data=data)).SerializeToString()
    assert b"".join(delimited(pb.Frame.RIGHT_FIELD_NUMBER, *parted)) == right


def test_a_high_field_number_takes_two_bytes() -> None:
    assert delimited(16, b"x") == [b"\x82\x01\x01", b"x"]
