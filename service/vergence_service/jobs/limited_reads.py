"""Files for the standard library to read, that give no more than their limits.

``zipfile`` and ``tarfile`` read as much at once as an archive asks for, and an .xz file may
ask for gigabytes of dictionary.
"""

import io
import lzma
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

from vergence_proto.errors import BadSequence, UploadTooLarge

_CHUNK = 1 << 16
# ``xz -9`` needs 65 MiB to be unpacked.
_XZ_BYTES = 96 << 20


def limited_reads(file: BinaryIO | io.BufferedIOBase, *, at_once: int, together: int) -> IO[bytes]:
    """Return ``file`` with limits on the bytes of one read, and of all reads together.

    It has every method that ``zipfile`` and ``tarfile`` need.
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


def open_xz(path: Path) -> io.BufferedReader:
    """Open an .xz file. Reading raises lzma.LZMAError if it needs more than 96 MiB."""
    return io.BufferedReader(_Xz(path))


class _Xz(io.RawIOBase):
    """An unpacked .xz file: one or more streams, one after the other."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._rewind()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position. Backwards, the file is unpacked from its beginning again."""
        if whence == io.SEEK_CUR:
            offset += self._at
        elif whence == io.SEEK_END:
            raise io.UnsupportedOperation("the size of an .xz file is not known")
        if offset < self._at:
            self._rewind()
        while self._at < offset and self._unpacked(min(_CHUNK, offset - self._at)):
            pass
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer)
        data = self._unpacked(len(view))
        view[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()

    def _rewind(self) -> None:
        self._file.seek(0)
        self._at = 0
        self._stream = _new_stream()

    def _unpacked(self, most: int) -> bytes:
        """Return the next bytes, or nothing at the end. Raises EOFError if the file is cut."""
        while True:
            if self._stream.eof:
                packed = self._stream.unused_data.lstrip(b"\0") or self._file.read(_CHUNK)
                if not packed.lstrip(b"\0"):
                    return b""
                self._stream = _new_stream()
            else:
                packed = self._file.read(_CHUNK) if self._stream.needs_input else b""
                if self._stream.needs_input and not packed:
                    raise EOFError("the .xz file is cut short")
            data = self._stream.decompress(packed, most)
            if data:
                self._at += len(data)
                return data


def _new_stream() -> lzma.LZMADecompressor:
    return lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_BYTES)
