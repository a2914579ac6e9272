"""Close a Zenoh session whose link may be dead, without waiting for the link."""

import os
import socket
import stat
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import zenoh

_DESCRIPTORS = Path("/dev/fd")  # Linux and macOS; Windows has none
_AT_ONCE = struct.pack("ii", 0, 0)  # SO_LINGER is off


def close_without_lingering(session: zenoh.Session) -> None:
    """Close a session; the kernel delivers in the background what was sent.

    Zenoh has the kernel hold the close of a TCP connection until all bytes are acknowledged, for up
    to ten seconds, in which the thread and the descriptor stay, and the process cannot exit.
    """
    with suppress(zenoh.ZError):  # the session is closed already
        for connection in connections_of(session):
            with connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
    session.close()


def connections_of(session: zenoh.Session) -> Iterator[socket.socket]:
    """Yield a duplicate of each TCP connection of a session, for the caller to close."""
    ends = {link.src.partition("/")[2].partition("?")[0] for link in session.info.links()}
    if not _DESCRIPTORS.exists():
        return
    # All before the first duplicate, which may take the number of the listing's own descriptor.
    descriptors = [each for each in map(int, os.listdir(_DESCRIPTORS)) if _is_socket(each)]
    for descriptor in descriptors:
        try:
            connection = socket.socket(fileno=os.dup(descriptor))
        except OSError:  # closed meanwhile by another thread
            continue
        if _is_tcp(connection) and _local_ends(connection) & ends:
            yield connection
        else:
            connection.close()


def _is_socket(descriptor: int) -> bool:
    try:
        return stat.S_ISSOCK(os.fstat(descriptor).st_mode)
    except OSError:
        return False


def _is_tcp(connection: socket.socket) -> bool:
    internet = connection.family in (socket.AF_INET, socket.AF_INET6)
    return internet and connection.type == socket.SOCK_STREAM


def _local_ends(connection: socket.socket) -> set[str]:
    host, port = connection.getsockname()[:2]
    return {f"{host}:{port}", f"[{host}]:{port}"}
