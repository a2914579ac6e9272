"""Serialisation of large messages by hand.

Protobuf copies bytes into the message, then into a buffer that it enlarges, then into the result.
That is four copies, or a millisecond for a pair of images. Pieces that are joined once need one
copy. (https://protobuf.dev/programming-guides/encoding/)
"""

Piece = bytes | memoryview  # items of one byte

_LENGTH_DELIMITED = 2  # the wire type of messages and bytes


def delimited(number: int, *pieces: Piece) -> list[Piece]:
    """Return the pieces of field ``number``, whose content is ``pieces`` joined."""
    size = sum(map(len, pieces))
    return [_varint(number << 3 | _LENGTH_DELIMITED) + _varint(size), *pieces]


def _varint(value: int) -> bytes:
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    groups.append(value)
    return bytes(groups)
