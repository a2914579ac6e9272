"""The limits of an archive, and the files that may be made from it.

Nothing that the archive states is trusted: unpacked bytes are counted, and names may only lead
below the folder.
"""

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from vergence_proto.errors import BadSequence, InsufficientStorage, UploadTooLarge

_LONGEST_NAME = 512
_LONGEST_PART_BYTES = 255  # limit of common file systems
# A colon or a backslash is a character like any other, but not on Windows.
_NOT_IN_NAMES = '\\/:*?"<>|\0' if os.name == "nt" else "\0"
# What an archive may unpack to beyond its ratio before all of it has come: its first files may be
# text, which shrinks more than images.
_EARLY_BYTES = 16 << 20
NAME_BYTES = 512  # what an empty file costs: the header of a tar, about an entry of a file system


@dataclass(frozen=True, slots=True, kw_only=True)
class ArchiveLimits:
    """The limits of one archive."""

    max_files: int
    max_unpacked_bytes: int
    # Largest unpacked size relative to the archive. Images are already compressed, so an archive of
    # images hardly shrinks; an archive of zeros shrinks a thousandfold.
    max_ratio: float


class ArchiveBudget:
    """Counts files and bytes against the limits, and against the disk's free space."""

    def __init__(self, limits: ArchiveLimits, free_bytes: int) -> None:
        self._limits = limits
        self.max_files = limits.max_files
        self._free_bytes = free_bytes
        self._files = 0
        self._headers = 0
        self._bytes = 0
        self._archive_bytes = 0
        self._complete = False

    def take_archive(self, count: int) -> None:
        """Count bytes of the archive that have come: it may unpack to more."""
        self._archive_bytes += count

    def complete(self) -> None:
        """Note that all of the archive has come. Raises UploadTooLarge."""
        self._complete = True
        self.check_bytes(self._bytes)

    @property
    def allowed_bytes(self) -> int:
        """What the archive may unpack to, as far as it has come."""
        early = 0 if self._complete else _EARLY_BYTES
        by_ratio = round(self._limits.max_ratio * self._archive_bytes) + early
        return min(self._limits.max_unpacked_bytes, by_ratio)

    def take_file(self, declared_bytes: int) -> None:
        """Count a file of a stated size. Raises UploadTooLarge and InsufficientStorage."""
        self._files += 1
        self._bytes += NAME_BYTES
        self.check_files(self._files)
        self._check(self._bytes + declared_bytes, self._limits.max_unpacked_bytes)
        self.check_bytes(self._bytes)

    def check_files(self, count: int) -> None:
        """Raise UploadTooLarge if these are too many files."""
        if count > self._limits.max_files:
            raise UploadTooLarge(
                f"expected at most {self._limits.max_files} files in the archive; the server's "
                "setting batch.max_files allows more"
            )

    def take_header(self) -> None:
        """Count a header of any kind, also of a folder."""
        self._headers += 1
        self.check_files(self._headers // 2)  # as many folders as files

    def take_bytes(self, count: int) -> None:
        """Count bytes that are written. Raises UploadTooLarge and InsufficientStorage."""
        self._bytes += count
        self.check_bytes(self._bytes)

    def check_bytes(self, count: int) -> None:
        """Raise UploadTooLarge or InsufficientStorage if there is no room for so many bytes."""
        self._check(count, self.allowed_bytes)

    def _check(self, count: int, allowed_bytes: int) -> None:
        if count > self._free_bytes:
            raise InsufficientStorage(
                f"the archive needs {count} bytes or more on the disk, and {self._free_bytes} are "
                "free; delete results, or make room on the server"
            )
        if count > allowed_bytes:
            raise UploadTooLarge(
                f"the archive unpacks to more than {allowed_bytes} bytes; the limit "
                f"is {self._limits.max_unpacked_bytes}, and {self._limits.max_ratio:g} times the "
                "archive's size (the server's settings batch.max_unpacked_mib and batch.max_ratio)"
            )


def target_path(folder: Path, name: str) -> Path:
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


def new_file(path: Path, name: str) -> BinaryIO:
    """Make the file of a member. Raises BadSequence if there is one already."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except (FileExistsError, NotADirectoryError, IsADirectoryError):
        raise BadSequence(f"the archive contains {name!r} twice") from None
