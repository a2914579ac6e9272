"""StreamDepth over HTTP: one long response of records, and one long request or one per message.

::

    POST /v1/streams            StreamDepthRequest with ``open``; the response lasts as long as the
                                call and consists of records
    POST /v1/streams/{call}     every other StreamDepthRequest; ``call`` is a secret, sent in the
                                header X-Call-Id of the response to the first request
    POST /v1/methods/{method}   the other methods of DepthService

A record is one byte with its kind, four bytes with its length (big-endian), and the content.

The body of ``POST /v1/streams/{call}`` is one message of ``application/x-protobuf``, or any number
of them as records, in a body that lasts as long as the call, if its type is
``application/vnd.vergence.records``. A server that takes records says so in the header Accept-Post
of its first response. Some proxies pass a body on only when it is whole: a client that hears no
answer then sends one message per request, as a browser does.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum

PROTOBUF_TYPE = "application/x-protobuf"
RECORDS_TYPE = "application/vnd.vergence.records"
CALL_ID_HEADER = "X-Call-Id"
ACCEPT_POST_HEADER = "Accept-Post"

RECORD_HEAD_BYTES = 5

_HEAD = struct.Struct(">BI")


class RecordKind(IntEnum):
    """The kind of a record, its first byte."""

    MESSAGE = 0
    """A StreamDepthResponse, or in a request a StreamDepthRequest."""
    END = 1
    """The end of the call: empty after success, else a FrameError with the reason."""


def read_head(head: bytes | bytearray) -> tuple[RecordKind, int]:
    """Return the kind of a record and its length without the head.

    Raises ValueError: there is no such kind.
    """
    kind, length = _HEAD.unpack_from(head)
    return RecordKind(kind), length


def pack_record(kind: RecordKind, content: bytes) -> bytes:
    """Return the bytes of one record."""
    return _HEAD.pack(kind, len(content)) + content


class RecordReader:
    """Assembles records from the chunks in which they arrive."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> Iterator[tuple[RecordKind, bytes]]:
        """Yield the records that ``chunk`` completes. Raises ValueError: there is no such kind."""
        self._buffer += chunk
        while len(self._buffer) >= _HEAD.size:
            kind, length = _HEAD.unpack_from(self._buffer)
            end = _HEAD.size + length
            if len(self._buffer) < end:
                return
            content = bytes(self._buffer[_HEAD.size : end])
            del self._buffer[:end]
            yield RecordKind(kind), content
