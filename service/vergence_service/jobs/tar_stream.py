"""Unpack a tar archive, compressed or not, while its bytes arrive: no copy of it is kept."""

import io
import tarfile
from pathlib import Path
from typing import BinaryIO

from vergence_proto.datasets.listing import is_data
from vergence_proto.errors import BadSequence
from vergence_service.jobs.archive_limits import ArchiveBudget, new_file, target_path
from vergence_service.jobs.decompression import Decompression

_BLOCK = tarfile.BLOCKSIZE
# Headers that belong to the member after them: long names, and attributes of POSIX.
_EXTENDED = (
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
)
_LONGEST_HEADERS = 1 << 16  # of one member
_LONGEST_MAGIC = 6


class TarUnpacker:
    """Writes the files of an archive below ``folder``. Its methods block; close it at the end.

    They raise BadSequence, UploadTooLarge and InsufficientStorage as
    :func:`vergence_service.jobs.archives.unpacking` does, and the errors of the standard library.
    """

    def __init__(self, folder: Path, budget: ArchiveBudget) -> None:
        self._folder = folder
        self._budget = budget
        self._packed = b""  # the first bytes, until the compression is known
        self._decompression: Decompression | None = None
        self._headers = bytearray()  # of the next member, as far as they have come
        self._needed = _BLOCK  # bytes of headers until the next decision
        self._in_extension = False
        self._left = 0  # bytes of the member that are to come
        self._padding = 0  # bytes after it
        self._file: BinaryIO | None = None
        self._begun = self._ended = False

    def feed(self, packed: bytes) -> None:
        """Unpack the next bytes of the archive."""
        if self._decompression is None:
            self._packed += packed
            if len(self._packed) < _LONGEST_MAGIC:
                return
            packed, self._packed = self._packed, b""
            self._decompression = Decompression(packed)
        if not self._ended:
            for data in self._decompression.pieces(packed):
                self._take(memoryview(data))
                if self._ended:
                    return

    def end(self) -> None:
        """Raise EOFError if the archive is cut short."""
        if self._ended:
            return
        if self._decompression is not None:
            self._decompression.end()
        if not self._begun or self._headers or self._left or self._packed:
            raise EOFError("it is cut short")

    def close(self) -> None:
        """Close the file that is being written."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _take(self, data: memoryview) -> None:
        while data and not self._ended:
            if self._left:
                piece, data = data[: self._left], data[self._left :]
                self._left -= len(piece)
                if self._file is not None:
                    self._budget.take_bytes(len(piece))
                    self._file.write(piece)
                if not self._left:
                    self.close()
            elif self._padding:
                skipped = min(self._padding, len(data))
                data = data[skipped:]
                self._padding -= skipped
            else:
                missing = self._needed - len(self._headers)
                self._headers += data[:missing]
                data = data[missing:]
                if len(self._headers) == self._needed:
                    self._take_headers()

    def _take_headers(self) -> None:
        if self._in_extension:  # the next block is another header
            self._in_extension = False
            self._needed += _BLOCK
            return
        block = bytes(self._headers[-_BLOCK:])
        if not any(block):
            self._ended = True
            return
        self._budget.take_header()
        if block[156:157] in _EXTENDED:
            size = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape").size
            if not 0 < size <= _LONGEST_HEADERS - self._needed:
                raise BadSequence(
                    f"expected headers of at most {_LONGEST_HEADERS} bytes in the archive"
                )
            self._needed += _whole_blocks(size)
            self._in_extension = True
            return
        with tarfile.open(fileobj=io.BytesIO(self._headers), mode="r:") as file:
            info = file.next()
        if info is None or info.size < 0:
            raise tarfile.ReadError("a header is damaged")
        self._headers, self._needed, self._begun = bytearray(), _BLOCK, True
        if not info.isdir():
            self._begin(info)

    def _begin(self, info: tarfile.TarInfo) -> None:
        if not info.isreg() or info.issparse():
            raise BadSequence(f"expected files and folders only, {info.name!r} is neither")
        # Bytes of another encoding: names that nobody looks for need not be text.
        name = info.name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
        self._budget.take_file(info.size)
        path = target_path(self._folder, name)
        self._left = info.size
        self._padding = _whole_blocks(info.size) - info.size
        if all(map(is_data, path.relative_to(self._folder).parts)):
            self._file = new_file(path, name)
            if not self._left:
                self.close()


def _whole_blocks(size: int) -> int:
    return -(-size // _BLOCK) * _BLOCK
