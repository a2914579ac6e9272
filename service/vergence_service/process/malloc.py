"""Tune the memory allocator of the process."""

import ctypes
import sys

if sys.platform != "win32":
    import resource

# From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_LARGEST_FRAME_BYTES = 1 << 28


def save_address_space() -> None:
    """Reserve less address space, if it is limited (``ulimit -v``). Call it before threads start.

    glibc reserves 64 MiB for each of a dozen threads, whether they use it or not.
    """
    if sys.platform != "linux" or resource.getrlimit(resource.RLIMIT_AS)[0] < 0:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 2)


def keep_freed_memory() -> bool:
    """Let malloc keep freed memory. Returns False if the C library is not glibc.

    A frame allocates and frees megabytes in a dozen pieces. By default, each piece returns to the
    kernel and is faulted in again, page by page, for the next frame. That takes about 1 ms.
    """
    try:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    except (OSError, TypeError):  # Windows has no library of that kind
        return False
    if mallopt is None:
        return False
    return bool(
        mallopt(_M_MMAP_THRESHOLD, _LARGEST_FRAME_BYTES)
        and mallopt(_M_TRIM_THRESHOLD, _LARGEST_FRAME_BYTES)
    )
