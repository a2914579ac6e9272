"""Tune the memory allocator of the process."""

import ctypes

# From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_FRAME_BYTES = 1 << 28


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
