"""Unpack an untrusted zip or tar archive into a folder, or refuse it.

Nothing that the archive states is trusted: unpacked bytes are counted, names may only lead below
the folder, and anything except files and folders is refused. What macOS adds (``__MACOSX``, names
with a dot in front) is passed over.
"""

import bz2
import errno
import gzip
import lzma
import os
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO

from vergence_proto.datasets.listing import is_data
from vergence_proto.errors import BadSequence, InsufficientStorage, UploadTooLarge
from vergence_service.jobs.limited_reads import limited_reads, open_xz
from vergence_service.jobs.storage import free_bytes

_CHUNK = 1 << 16
_LONGEST_NAME = 512
_ENTRY_BYTES = 160  # of a usual name in the directory of a zip
_LEAST_DIRECTORY = 1 << 20
_NAME_BYTES = 512  # what an empty file costs: the header of a tar, about an entry of a file system
_LONGEST_PART_BYTES = 255  # limit of common file systems
# A colon or a backslash is a character like any other, but not on Windows.
_NOT_IN_NAMES = '\\/:*?"<>|\0' if os.name == "nt" else "\0"
_ZIP_START = b"PK"
_DECOMPRESSORS: dict[bytes, Callable[[Path], BufferedIOBase]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": open_xz,
}
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
    RecursionError,  # a header of a tar that says that another one follows, and so on
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArchiveLimits:
    """The limits of one archive."""

    max_files: int
    max_unpacked_bytes: int
    # Largest unpacked size relative to the archive. Images are already compressed, so an archive of
    # images hardly shrinks; an archive of zeros shrinks a thousandfold.
    max_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class _Member:
    name: str
    declared_bytes: int
    open: Callable[[], IO[bytes]]


def unpacking(archive: Path, folder: Path, limits: ArchiveLimits) -> Iterator[None]:
    """Unpack into ``folder``, and yield after each short piece of work.

    The caller removes the folder if this raises or is closed before its end.

    Raises BadSequence if the file is not a zip or tar archive, is damaged or encrypted, or contains
    links or names that lead out of the folder. Raises UploadTooLarge if it has more files, bytes or
    compression than ``limits`` allow, and InsufficientStorage if the disk has no room for it.
    """
    with archive.open("rb") as file:
        start = file.read(8)
    allowed = min(limits.max_unpacked_bytes, round(limits.max_ratio * archive.stat().st_size))
    budget = _Budget(limits, allowed, free_bytes(folder))
    members = _zip_members if start.startswith(_ZIP_START) else _tar_members
    try:
        for member in members(archive, start, budget):
            budget.take_file(member)
            path = _target_path(folder, member.name)
            if all(map(is_data, path.relative_to(folder).parts)):
                yield from _writing(member, path, budget)
    except _DAMAGED as error:
        raise BadSequence(f"expected a complete zip or tar archive: {error}") from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # an offset before the beginning of the file
            raise
        raise BadSequence("expected a complete zip or tar archive: an offset is wrong") from None


class _Budget:
    """Counts files and bytes against the limits."""

    def __init__(self, limits: ArchiveLimits, allowed_bytes: int, free_bytes: int) -> None:
        self._limits = limits
        self.max_files = limits.max_files
        self._free_bytes = free_bytes
        self._files = 0
        self._headers = 0
        self._bytes = 0
        self._allowed_bytes = allowed_bytes

    def take_file(self, member: _Member) -> None:
        self._files += 1
        self._bytes += _NAME_BYTES
        self.check_files(self._files)
        self._check(self._bytes + member.declared_bytes)

    def check_all(self, members: Sequence[_Member]) -> None:
        """Check all members at once, where an archive lists them, before any is written."""
        self.check_files(len(members))
        self._check(sum(_NAME_BYTES + member.declared_bytes for member in members))

    def check_files(self, count: int) -> None:
        if count > self._limits.max_files:
            raise UploadTooLarge(
                f"expected at most {self._limits.max_files} files in the archive; the server's "
                "setting batch.max_files allows more"
            )

    def take_header(self) -> None:
        """Count a member of any kind, also a folder."""
        self._headers += 1
        self.check_files(self._headers // 2)  # as many folders as files

    def limited(self, file: BinaryIO | BufferedIOBase, *, at_once: int) -> IO[bytes]:
        """Return the archive for the standard library to read, within the limits."""
        headers = max(_LEAST_DIRECTORY, self._limits.max_files * 2 * _NAME_BYTES)
        return limited_reads(file, at_once=at_once, together=self._allowed_bytes + headers)

    def take_bytes(self, count: int) -> None:
        self._bytes += count
        self._check(self._bytes)

    def _check(self, count: int) -> None:
        if count > self._free_bytes:
            raise InsufficientStorage(
                f"the archive needs {count} bytes or more on the disk, and {self._free_bytes} are "
                "free; delete results, or make room on the server"
            )
        if count > self._allowed_bytes:
            raise UploadTooLarge(
                f"the archive unpacks to more than {self._allowed_bytes} bytes; the limit "
                f"is {self._limits.max_unpacked_bytes}, and {self._limits.max_ratio:g} times the "
                "archive's size (the server's settings batch.max_unpacked_mib and batch.max_ratio)"
            )


def _target_path(folder: Path, name: str) -> Path:
    """Return the path to unpack a member to. Raises BadSequence if it is not below ``folder``."""
    path = PurePosixPath(name)
    parts = [part for part in path.parts if part != "."]
    bad = not parts or path.is_absolute() or len(name) > _LONGEST_NAME
    if bad or any(map(_is_bad_part, parts)):
        raise BadSequence(f"expected names below the archive's own folder, got {name[:100]!r}")
    return folder.joinpath(*parts)


def _is_bad_part(part: str) -> bool:
    too_long = len(part.encode()) > _LONGEST_PART_BYTES
    return too_long or part == ".." or not set(part).isdisjoint(_NOT_IN_NAMES)


def _writing(member: _Member, path: Path, budget: _Budget) -> Iterator[None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with member.open() as source, path.open("xb") as target:
            while chunk := source.read(_CHUNK):
                budget.take_bytes(len(chunk))
                target.write(chunk)
                yield
        yield
    except (FileExistsError, NotADirectoryError, IsADirectoryError):
        raise BadSequence(f"the archive contains {member.name!r} twice") from None


def _zip_members(archive: Path, start: bytes, budget: _Budget) -> Iterator[_Member]:
    # zipfile reads the whole directory at once, and makes an object of each entry.
    directory = max(_LEAST_DIRECTORY, budget.max_files * _ENTRY_BYTES)
    with (
        archive.open("rb") as opened,
        zipfile.ZipFile(budget.limited(opened, at_once=directory)) as file,
    ):
        listed = list(_listed(file))
        budget.check_all(listed)
        yield from listed


def _listed(file: zipfile.ZipFile) -> Iterator[_Member]:
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
        yield _Member(name, info.file_size, _opener(file, info))


def _opener(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> Callable[[], IO[bytes]]:
    return lambda: file.open(info)


def _tar_members(archive: Path, start: bytes, budget: _Budget) -> Iterator[_Member]:
    opened = next(
        (
            decompressor(archive)
            for magic, decompressor in _DECOMPRESSORS.items()
            if start.startswith(magic)
        ),
        None,
    ) or archive.open("rb")
    # tarfile reads extended headers of any stated length.
    with opened, tarfile.open(fileobj=budget.limited(opened, at_once=_CHUNK), mode="r:") as file:
        while (info := file.next()) is not None:
            # It remembers all members, with all that their headers say.
            file.members.clear()  # type: ignore[attr-defined] # not in its stubs
            budget.take_header()
            if info.isdir():
                continue
            content = file.extractfile(info) if info.isreg() and not info.issparse() else None
            if content is None:
                raise BadSequence(f"expected files and folders only, {info.name!r} is neither")
            # Bytes of another encoding: names that nobody looks for need not be text.
            name = info.name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
            yield _Member(name, info.size, _same(content))


def _same(content: IO[bytes]) -> Callable[[], IO[bytes]]:
    return lambda: content
