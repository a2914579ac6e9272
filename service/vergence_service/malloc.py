"""How the process holds on to memory."""

import ctypes

# From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_FRAME_BYTES = 1 << 28


def keep_freed_memory() -> bool:
    """Let malloc keep what is freed, where the C library is glibc; tells whether it is.

    A frame takes and frees megabytes in a dozen pieces. By default each piece goes back to the
    kernel and is faulted in again, page by page, for the next frame: about a millisecond of it.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(
        mallopt(_M_MMAP_THRESHOLD, _LARGEST_FRAME_BYTES)
        and mallopt(_M_TRIM_THRESHOLD, _LARGEST_FRAME_BYTES)
    )
