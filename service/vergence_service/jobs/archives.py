"""Unpack an untrusted zip or tar archive into a folder, or refuse it.

Anything except files and folders is refused; see :mod:`vergence_service.jobs.archive_limits` for
names and sizes. What macOS adds (``__MACOSX``, names with a dot in front) is passed over. A tar is
unpacked while it arrives. A zip has its directory at the end: when it is complete, it is unpacked
from there to its beginning, and the file shrinks meanwhile. So there is one copy on the disk.
"""

import errno
import gzip
import lzma
import os
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vergence_proto.datasets.listing import is_data
from vergence_proto.errors import BadSequence
from vergence_service.jobs.archive_limits import (
    NAME_BYTES,
    ArchiveBudget,
    ArchiveLimits,
    new_file,
    target_path,
)
from vergence_service.jobs.limited_reads import limited_reads
from vergence_service.jobs.storage import free_bytes
from vergence_service.jobs.tar_stream import TarUnpacker

_CHUNK = 1 << 16
_ENTRY_BYTES = 160  # of a usual name in the directory of a zip
_LEAST_DIRECTORY = 1 << 20
_ZIP_START = b"PK"
# Errors of the standard library about archives that are damaged or malicious.
_DAMAGED = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    NotImplementedError,  # zipfile does not know the compression
    gzip.BadGzipFile,
    UnicodeError,
    ValueError,
    RecursionError,
)


class ArchiveUnpacker:
    """Unpacks an archive into ``folder`` while it arrives. Its methods block.

    ``scratch`` is the path for a zip until it is complete. The caller removes both if a method
    raises. They raise BadSequence if the file is not a zip or tar archive, is damaged or encrypted,
    or contains links or names that lead out of the folder; UploadTooLarge if it has more files,
    bytes or compression than ``limits`` allow; and InsufficientStorage if the disk has no room.
    """

    def __init__(self, folder: Path, scratch: Path, limits: ArchiveLimits) -> None:
        self._folder, self._scratch, self._limits = folder, scratch, limits
        self._budget = ArchiveBudget(limits, free_bytes(folder))
        self._tar = TarUnpacker(folder, self._budget)
        self._start = b""
        self._is_zip: bool | None = None  # None: too little has come
        self._file: BinaryIO | None = None  # of a zip

    def feed(self, data: bytes) -> None:
        """Take the next bytes of the archive."""
        self._budget.take_archive(len(data))
        if self._is_zip is None:
            data = self._start = self._start + data
            if len(data) < len(_ZIP_START):
                return
            self._is_zip = data.startswith(_ZIP_START)
            self._start = b""
            if self._is_zip:
                self._file = self._scratch.open("wb")
        if self._file is not None:
            self._file.write(data)
            return
        with _damage_refused():
            self._tar.feed(data)

    def finishing(self) -> Iterator[None]:
        """Unpack what waited for the end, and yield after each short piece of work."""
        if self._is_zip:
            self.close()
            yield from _unpacking_zip(self._scratch, self._folder, self._budget, consume=True)
            self._scratch.unlink()
            return
        with _damage_refused():
            if self._is_zip is None:
                raise EOFError("it is cut short")
            self._tar.end()
        self._budget.complete()

    def close(self) -> None:
        """Close the files that are being written."""
        self._tar.close()
        if self._file is not None:
            self._file.close()
            self._file = None


def unpacking(archive: Path, folder: Path, limits: ArchiveLimits) -> Iterator[None]:
    """Unpack a file that stays as it is, and yield after each short piece of work.

    The caller removes ``folder`` if this raises or is closed before its end. Raises what
    :class:`ArchiveUnpacker` does.
    """
    budget = ArchiveBudget(limits, free_bytes(folder))
    budget.take_archive(archive.stat().st_size)
    budget.complete()
    with archive.open("rb") as file:
        if file.read(len(_ZIP_START)) == _ZIP_START:
            yield from _unpacking_zip(archive, folder, budget, consume=False)
            return
        file.seek(0)
        tar = TarUnpacker(folder, budget)
        try:
            with _damage_refused():
                while chunk := file.read(_CHUNK):
                    tar.feed(chunk)
                    yield
                tar.end()
        finally:
            tar.close()


@contextmanager
def _damage_refused() -> Iterator[None]:
    """Raise BadSequence for what the standard library says about a damaged archive."""
    try:
        yield
    except _DAMAGED as error:
        raise BadSequence(f"expected a complete zip or tar archive: {error}") from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # an offset before the beginning of the file
            raise
        raise BadSequence("expected a complete zip or tar archive: an offset is wrong") from None


def _unpacking_zip(
    archive: Path, folder: Path, budget: ArchiveBudget, *, consume: bool
) -> Iterator[None]:
    # zipfile reads the whole directory at once, and makes an object of each entry.
    directory = max(_LEAST_DIRECTORY, budget.max_files * _ENTRY_BYTES)
    budget.complete()
    headers = max(_LEAST_DIRECTORY, budget.max_files * 2 * NAME_BYTES)
    together = budget.allowed_bytes + headers
    with (
        _damage_refused(),
        archive.open("rb") as opened,
        zipfile.ZipFile(limited_reads(opened, at_once=directory, together=together)) as file,
    ):
        members = dict(_listed(file))
        budget.check_files(len(members))
        budget.check_bytes(sum(NAME_BYTES + info.file_size for info in members))
        for info, name in sorted(
            members.items(), key=lambda each: each[0].header_offset, reverse=consume
        ):
            budget.take_file(info.file_size)
            path = target_path(folder, name)
            if all(map(is_data, path.relative_to(folder).parts)):
                with new_file(path, name) as target, file.open(info) as source:
                    while chunk := source.read(_CHUNK):
                        budget.take_bytes(len(chunk))
                        target.write(chunk)
                        yield
            if consume:
                os.truncate(archive, info.header_offset)
            yield


def _listed(file: zipfile.ZipFile) -> Iterator[tuple[zipfile.ZipInfo, str]]:
    # Some tools of Windows write backslashes where the format says slashes.
    windows = not any("/" in info.filename for info in file.infolist())
    for info in file.infolist():
        name = info.filename.replace("\\", "/") if windows else info.filename
        if name.endswith("/"):
            continue
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG):
            raise BadSequence(f"expected files and folders only, {info.filename!r} is a link")
        if info.flag_bits & 1:
            raise BadSequence(f"expected an archive without a password: {info.filename!r}")
        yield info, name
