"""Lines that C libraries write to stderr: those of image decoders are counted, others are logged.

libpng and libjpeg write a line for each damaged image, so one client could fill the log. They write
to C's ``stderr``, which is a variable of the C library. While lines are captured, it is a pipe. The
descriptor 2 stays as it is, for Python, for crashes and for child processes.
"""

import ctypes
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2

if sys.platform == "linux":
    import fcntl

log = logging.getLogger(__name__)

_PIPE_BYTES = 1 << 20
_BY_LINE = 1  # _IOLBF of stdio.h
# The messages of libjpeg that can reach stderr (jerror.h).
_JPEG_MESSAGES = (
    "Corrupt JPEG data",
    "Premature end of JPEG",
    "Invalid SOS parameters",
    "Inconsistent progression",
    "Unknown Adobe color",
    "Warning: unknown JFIF",
    "Unsupported JPEG",
    "Unsupported marker",
    "Application transferred",
)


def decoder_of(line: str) -> str | None:
    """Return the decoder that writes such a line, "png" or "jpeg", or None."""
    if line.startswith("libpng "):
        return "png"
    return "jpeg" if line.startswith(_JPEG_MESSAGES) else None


@contextmanager
def native_output(count: Callable[[str], None]) -> Iterator[None]:
    """During the block, call ``count`` with the decoder of each line, from another thread.

    Only glibc has such a variable; with another C library nothing changes.
    """
    cv2.utils.logging.setLogLevel(
        cv2.utils.logging.LOG_LEVEL_SILENT
    )  # OpenCV says again what it returns
    libc: Any = ctypes.CDLL(None) if sys.platform == "linux" else None
    if not hasattr(libc, "gnu_get_libc_version"):
        yield
        return
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    os.set_blocking(writing, False)  # a decoder must not wait; lines beyond the room are lost
    libc.fdopen.restype = ctypes.c_void_p
    pipe = ctypes.c_void_p(libc.fdopen(writing, b"w"))
    libc.setvbuf(pipe, None, _BY_LINE, ctypes.c_size_t(0))
    variable = ctypes.c_void_p.in_dll(libc, "stderr")
    thread = threading.Thread(target=_read, args=(reading, count), name="native output")
    thread.start()
    before, variable.value = variable.value, pipe.value
    try:
        yield
    finally:
        variable.value = before
        libc.fclose(pipe)
        thread.join()


def _read(descriptor: int, count: Callable[[str], None]) -> None:
    with os.fdopen(descriptor, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if (decoder := decoder_of(line)) is not None:
                count(decoder)
            elif line.strip():
                log.warning("%s", line.rstrip())
