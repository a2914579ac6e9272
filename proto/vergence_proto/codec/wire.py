"""Large messages by hand: they are written with one copy, and read without any.

Protobuf copies bytes into the message, then into a buffer that it enlarges, then into the result.
That is four copies, or a millisecond for a pair of images. Pieces that are joined once need one
copy. In the other direction, every field that protobuf parses costs up to forty times its bytes,
and one message may name a field millions of times. So the bytes are looked at first.
(https://protobuf.dev/programming-guides/encoding/)
"""

from collections.abc import Iterator
from typing import NamedTuple

Piece = bytes | memoryview  # items of one byte

# Wire types.
_VARINT = 0
_LENGTH_DELIMITED = 2  # of messages and bytes
_FIXED_BYTES = {1: 8, 5: 4}


class WireField(NamedTuple):
    """One field of a message, where it lies in the message's bytes."""

    number: int
    """The number of the field in its message."""
    content: memoryview | None
    """The content of a message or of bytes; None for a number."""
    whole: memoryview
    """The field with its number and its length."""


def delimited(number: int, *pieces: Piece) -> list[Piece]:
    """Return the pieces of field ``number``, whose content is ``pieces`` joined."""
    size = sum(map(len, pieces))
    return [_varint(number << 3 | _LENGTH_DELIMITED) + _varint(size), *pieces]


def fields_of(message: memoryview) -> Iterator[WireField]:
    """Yield the fields of a message in order, without a copy and without reading into them.

    Raises ValueError: the bytes are not fields.
    """
    at = 0
    while at < len(message):
        tag, start = _read_varint(message, at)
        content: memoryview | None = None
        wire_type = tag & 7
        if wire_type == _LENGTH_DELIMITED:
            length, start = _read_varint(message, start)
            end = start + length
            content = message[start:end]
        elif wire_type == _VARINT:
            _, end = _read_varint(message, start)
        elif wire_type in _FIXED_BYTES:
            end = start + _FIXED_BYTES[wire_type]
        else:
            raise ValueError(f"there is no wire type {wire_type}")
        if end > len(message):
            raise ValueError("a field is cut short")
        yield WireField(tag >> 3, content, message[at:end])
        at = end


def _read_varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return the number at ``at`` and the position behind it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number has no end")


def _varint(value: int) -> bytes:
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    groups.append(value)
    return bytes(groups)
