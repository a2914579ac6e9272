"""End a call whose client does not listen.

A status cannot reach a client that does not read: it waits behind the messages before it. gRPC for
Python has no method that ends a call without a status.
"""

import asyncio
import os
import socket
import stat
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import unquote

import grpc
from grpc._cython import cygrpc  # type: ignore[attr-defined] # published without types

from vergence_service.transports.grpc.errors import Context

# Time for the status to reach a client that is silent but reads.
_STATUS_S = 1.0


async def hang_up(context: Context, why: str, *, reads: bool, shared: bool) -> None:
    """End the call with UNAVAILABLE, as if its connection were lost. Does not return.

    If the client does not read, end the call without a status, or, unless the connection is
    ``shared`` by other calls, close the connection.
    """
    if reads:
        try:
            async with asyncio.timeout(_STATUS_S):
                await context.abort(grpc.StatusCode.UNAVAILABLE, why)
        except TimeoutError:
            pass
        except grpc.aio.InternalError:  # the client has disconnected meanwhile
            raise asyncio.CancelledError from None
    if shared or not _close_connection(context.peer()):
        _cancel(context)
    raise asyncio.CancelledError  # gRPC takes this as the end of a call that was cancelled


def _close_connection(peer: str) -> bool:
    """Close the TCP connection to ``peer``, as gRPC states it. Return True if it was found."""
    _, _, address = unquote(peer).partition(":")
    host, _, port = address.rpartition(":")
    for descriptor in _sockets():
        # A copy of the descriptor. A name of AF_INET6 has room for one of IPv4 too.
        with (
            suppress(OSError),  # it has been closed
            socket.fromfd(descriptor, socket.AF_INET6, socket.SOCK_STREAM) as connection,
        ):
            if _is_peer(connection.getpeername(), host.strip("[]"), port):
                connection.shutdown(socket.SHUT_RDWR)
                return True
    return False


def _is_peer(name: Any, host: str, port: str) -> bool:
    """Decide whether a socket's name is this address. IPv4 may be written as IPv6."""
    return (
        isinstance(name, tuple)
        and str(name[1]) == port
        and str(name[0]).removeprefix("::ffff:") == host
    )


def _sockets() -> Iterator[int]:
    """Yield the descriptors of all sockets of this process, where the system lists them."""
    with suppress(OSError):
        for name in os.listdir("/dev/fd"):  # Linux and macOS
            with suppress(OSError):
                if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                    yield int(name)


def _cancel(context: Context) -> None:
    """Cancel a call.

    Only gRPC's own functions get at the call behind a context. This takes the place of one of them
    for as long as ``context.auth_context`` needs to call it.
    """
    here = threading.get_ident()
    theirs = cygrpc.auth_context

    def cancel(call: Any) -> Any:
        if threading.get_ident() != here:
            return theirs(call)
        call.cancel(grpc.StatusCode.UNAVAILABLE.value[0], "the client does not read")
        return {}

    cygrpc.auth_context = cancel
    try:
        context.auth_context()
    finally:
        cygrpc.auth_context = theirs
