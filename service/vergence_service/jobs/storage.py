"""The disk of the jobs: its free space, its troubles, and files that survive a power cut."""

import errno
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path

from vergence_proto.errors import InsufficientStorage

# Errors that say nothing about the file that is read or written, and that may pass.
_TROUBLE = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the system limits the size of files",
    errno.EROFS: "the disk is read-only",
    errno.EIO: "the disk fails",
    errno.ENODEV: "the disk is gone",
    errno.ESTALE: "the disk is gone",
}
_DATABASE_TROUBLE = {
    sqlite3.SQLITE_FULL: "the disk is full",
    sqlite3.SQLITE_IOERR: "the disk fails",
    sqlite3.SQLITE_READONLY: "the disk is read-only",
    sqlite3.SQLITE_CANTOPEN: "the disk fails",
}
_PRIMARY_CODE = 0xFF  # the rest of SQLite's code says more about the same trouble


def disk_trouble(error: BaseException) -> str | None:
    """Return what is wrong with the disk if ``error`` or a cause of it says so, otherwise None."""
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, OSError) and cause.errno in _TROUBLE:
            return _TROUBLE[cause.errno]
        if isinstance(cause, sqlite3.Error):
            # Errors of the module itself have no code.
            code = getattr(cause, "sqlite_errorcode", 0) & _PRIMARY_CODE
            if code in _DATABASE_TROUBLE:
                return _DATABASE_TROUBLE[code]
        cause = cause.__cause__ or cause.__context__
    return None


def free_bytes(folder: Path) -> int:
    """Return the free space of the disk of a folder."""
    return shutil.disk_usage(folder).free


def check_free(folder: Path, needed_bytes: int, *, promised_bytes: int, what: str) -> None:
    """Raise InsufficientStorage unless the disk has room for ``needed_bytes`` more.

    ``promised_bytes`` is space that accepted jobs still need.
    """
    free = free_bytes(folder) - promised_bytes
    if needed_bytes > free:
        raise InsufficientStorage(
            f"{what} needs {needed_bytes} bytes on the disk, and {max(free, 0)} are free"
            + (f", besides {promised_bytes} for accepted sequences" if promised_bytes else "")
            + "; delete results, or make room on the server"
        )


def flushing(folder: Path) -> Iterator[None]:
    """Write all files of a folder to the disk, and yield after each."""
    for parent, _, names in os.walk(folder):
        for name in names:
            flush_path(Path(parent) / name)
            yield
        flush_path(Path(parent))
        yield


def linking(source: Path, target: Path) -> Iterator[None]:
    """Give all files of a folder a second name below ``target``, and yield after each."""
    for parent, _, names in os.walk(source):
        there = target / Path(parent).relative_to(source)
        there.mkdir(parents=True)
        for name in names:
            try:
                os.link(Path(parent) / name, there / name)
            except OSError:  # a file system without links
                shutil.copyfile(Path(parent) / name, there / name)
            yield


def flush_path(path: Path) -> None:
    """Write a file, or the names in a folder, to the disk."""
    if sys.platform == "win32" and path.is_dir():
        return  # Windows cannot, and needs not
    descriptor = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
