"""File descriptors: every connection and every open file takes one."""

import sys

if sys.platform != "win32":
    import resource

# The server's own: libraries, the database, files of jobs, and connections that are being refused.
_RESERVED = 32
# A connection of HTTP may have a file, and there are connections of gRPC and of HTTP.
_FOR_EACH = 3


def raise_descriptor_limit() -> None:
    """Raise the limit of this process as far as the system allows."""
    if sys.platform == "win32":
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    except (OSError, ValueError):  # macOS has a lower limit than it states
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def affordable_connections(wanted: int) -> int:
    """Return how many connections each transport can have, ``wanted`` at most."""
    if sys.platform == "win32":
        return wanted
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return wanted
    return min(wanted, max((soft - _RESERVED) // _FOR_EACH, 1))
