"""Connections of the HTTP server: their number, and what a slow or silent client may cost."""

import asyncio
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

_TOO_MANY = (
    b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 5\r\nconnection: close\r\n"
    b"content-length: 0\r\n\r\n"
)
_NO_HEADERS = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
# A host that vanished is noticed after 10 + 2 x 5 s.
_KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 2, "TCP_USER_TIMEOUT": 20_000}


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """The limits of the connections of the HTTP server."""

    connections: int  # most at once
    headers_s: float  # time for the headers of a request
    write_s: float  # disconnect a client that does not read for this long
    min_bytes_per_s: float  # slowest upload and download


class BoundedConnection(H11Protocol):
    """A connection of uvicorn with deadlines for the headers and for reading the answers.

    The body of a request has a deadline where it is read, see
    :mod:`vergence_service.transports.http.bodies`.
    """

    def __init__(self, limits: ConnectionLimits, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._limits = limits
        self._headers_due: asyncio.TimerHandle | None = None
        self._read_due: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn's
        super().connection_made(transport)
        _keep_alive(transport.get_extra_info("socket"))
        names = _certificate_names(transport.get_extra_info("peercert") or {})
        self.app_state = {**self.app_state, "certificate_names": names}
        # Every byte that the client has not read is noticed. Over TLS, no bytes at all would reach
        # a limit of 0.
        over_tls = transport.get_extra_info("sslcontext") is not None
        transport.set_write_buffer_limits(high=int(over_tls), low=0)
        if len(self.connections) > self._limits.connections:
            transport.write(_TOO_MANY)
            transport.close()
            return
        self._expect_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        for due in (self._headers_due, self._read_due):
            if due is not None:
                due.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.cycle is None or self.cycle.response_complete:
            self._expect_headers()
        elif self._headers_due is not None:
            self._headers_due.cancel()
            self._headers_due = None

    def pause_writing(self) -> None:
        super().pause_writing()
        self._expect_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._read_due is not None:
            self._read_due.cancel()
            self._read_due = None

    def _expect_headers(self) -> None:
        """Start the time for the headers of the next request, unless it runs."""
        if self._headers_due is None and not self.transport.is_closing():
            self._headers_due = self.loop.call_later(self._limits.headers_s, self._no_headers)

    def _no_headers(self) -> None:
        if not self.transport.is_closing():
            self.transport.write(_NO_HEADERS)
            self.transport.close()

    def _expect_reading(self) -> None:
        unread = self.transport.get_write_buffer_size()
        self._read_due = self.loop.call_later(self._limits.write_s, self._check_reading, unread)

    def _check_reading(self, unread_before: int) -> None:
        read = unread_before - self.transport.get_write_buffer_size()
        if read < self._limits.min_bytes_per_s * self._limits.write_s:
            self.transport.abort()
        else:
            self._expect_reading()


def _certificate_names(certificate: Mapping[str, Any]) -> list[str]:
    """Return the names in a client's certificate: alternative names, then the common name."""
    names = [name for _, name in certificate.get("subjectAltName", ())]
    subject = [pair for group in certificate.get("subject", ()) for pair in group]
    return names + [name for kind, name in subject if kind == "commonName"]


def _keep_alive(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):  # they differ between systems
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
