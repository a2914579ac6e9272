"""Decompress gzip, bzip2 and xz from bytes as they arrive, in pieces of bounded size."""

import bz2
import lzma
import zlib
from collections.abc import Callable, Iterator
from typing import Protocol

_PIECE = 1 << 16
_GZIP_WBITS = 31
# ``xz -9`` needs 65 MiB to be unpacked; a file may ask for gigabytes of dictionary.
_XZ_BYTES = 96 << 20


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    @property
    def needs_input(self) -> bool: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


class _Gzip:
    """zlib's decompressor with the methods of the others."""

    def __init__(self) -> None:
        self._inner = zlib.decompressobj(_GZIP_WBITS)
        self.needs_input = True

    @property
    def eof(self) -> bool:
        return self._inner.eof

    @property
    def unused_data(self) -> bytes:
        return self._inner.unused_data

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        found = self._inner.decompress(self._inner.unconsumed_tail + data, max_length)
        self.needs_input = not self._inner.unconsumed_tail and len(found) < max_length
        return found


def _xz() -> _Decompressor:
    return lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_BYTES)


_KINDS: dict[bytes, Callable[[], _Decompressor]] = {
    b"\x1f\x8b": _Gzip,
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ": _xz,
}


class Decompression:
    """Decompresses a file of one or more streams, or passes on one that is not compressed."""

    def __init__(self, start: bytes) -> None:
        """``start``: the first bytes of the file, six at least if it has as many."""
        self._make = next((make for magic, make in _KINDS.items() if start.startswith(magic)), None)
        self._stream: _Decompressor | None = None
        self.compressed = self._make is not None

    def pieces(self, packed: bytes) -> Iterator[bytes]:
        """Yield what the next bytes of the file decompress to. Raises what the libraries raise."""
        if self._make is None:
            yield packed
            return
        while True:
            if self._stream is None:
                packed = packed.lstrip(b"\0")  # padding between two streams
                if not packed:
                    return
                self._stream = self._make()
            data = self._stream.decompress(packed, _PIECE)
            packed = b""
            if data:
                yield data
            if self._stream.eof:
                packed, self._stream = self._stream.unused_data, None
            elif self._stream.needs_input:
                return

    def end(self) -> None:
        """Raise EOFError if the file is cut short."""
        if self._stream is not None:
            raise EOFError("the compressed file is cut short")
