"""A StreamDepth call over HTTP, which has no messages: two kinds of request and one long answer.

::

    POST /v1/streams            StreamDepthRequest with ``open``; the answer lasts as long as the
                                call and is made of records
    POST /v1/streams/{call}     StreamDepthRequest with anything else; ``call`` is what the answer's
                                header X-Call-Id says, which nobody else can know
    POST /v1/methods/{method}   the other methods of DepthService

A record is one byte that says its kind, four with the length (big-endian), and the content.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum

PROTOBUF_TYPE = "application/x-protobuf"
RECORDS_TYPE = "application/vnd.vergence.records"
CALL_ID_HEADER = "X-Call-Id"

_HEAD = struct.Struct(">BI")


class RecordKind(IntEnum):
    MESSAGE = 0  # a StreamDepthResponse
    END = 1  # of the call: empty in peace, else a FrameError that says why


def pack_record(kind: RecordKind, content: bytes) -> bytes:
    return _HEAD.pack(kind, len(content)) + content


class RecordReader:
    """Puts records together from the pieces in which they arrive."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, piece: bytes) -> Iterator[tuple[RecordKind, bytes]]:
        """The records that ``piece`` completes. Raises ValueError: no such kind."""
        self._buffer += piece
        while len(self._buffer) >= _HEAD.size:
            kind, length = _HEAD.unpack_from(self._buffer)
            end = _HEAD.size + length
            if len(self._buffer) < end:
                return
            content = bytes(self._buffer[_HEAD.size : end])
            del self._buffer[:end]
            yield RecordKind(kind), content
