"""Messages of megabytes, laid out by hand.

Protobuf copies bytes into the message that gets them, from there into a buffer that it lets grow,
and from there into the result: four copies, and for a pair of images that is a millisecond. In
pieces that are joined once it is one. (https://protobuf.dev/programming-guides/encoding/)
"""

Piece = bytes | memoryview  # one byte an item

_LENGTH_DELIMITED = 2  # the wire type of messages and bytes


def delimited(number: int, *pieces: Piece) -> list[Piece]:
    """Field ``number``, a message or bytes that ``pieces`` are when joined."""
    size = sum(map(len, pieces))
    return [_varint(number << 3 | _LENGTH_DELIMITED) + _varint(size), *pieces]


def _varint(value: int) -> bytes:
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    groups.append(value)
    return bytes(groups)
