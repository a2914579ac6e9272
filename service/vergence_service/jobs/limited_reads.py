"""Files for the standard library to read, that give no more than their limits.

``zipfile`` reads as much at once as an archive asks for.
"""

import io
from typing import IO, BinaryIO, cast

from vergence_proto.errors import BadSequence, UploadTooLarge


def limited_reads(file: BinaryIO | io.BufferedIOBase, *, at_once: int, together: int) -> IO[bytes]:
    """Return ``file`` with limits on the bytes of one read, and of all reads together.

    It has every method that ``zipfile`` needs.
    """
    return cast(IO[bytes], _LimitedReads(file, at_once, together))


class _LimitedReads:
    def __init__(self, file: BinaryIO | io.BufferedIOBase, at_once: int, together: int) -> None:
        self._file = file
        self._at_once = at_once
        self._left = together
        self.seek = file.seek
        self.tell = file.tell
        self.seekable = file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(self._at_once + 1 if size < 0 else min(size, self._at_once + 1))
        if len(data) > self._at_once:
            raise BadSequence(f"expected headers of at most {self._at_once} bytes in the archive")
        self._left -= len(data)
        if self._left < 0:
            raise UploadTooLarge("the headers of the archive are larger than its files may be")
        return data
