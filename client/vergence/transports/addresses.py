"""Parsing of server addresses, and the choice of a transport."""

import ipaddress
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from vergence.transports.credentials import Credentials
from vergence_proto.extras import how_to_install
from vergence_proto.zenoh.keys import DEFAULT_NAMESPACE

if TYPE_CHECKING:  # the commands check addresses before they need a transport
    from vergence.transports.base import Transport

DEFAULT_SERVER = "grpc://127.0.0.1:50051"
"""The address of a server on this machine with its default port."""

_EXPECTED = (
    "expected a server as grpc://HOST:PORT or http://HOST:PORT (grpcs, https: encrypted) or "
    "zenoh://HOST:PORT[/NAMESPACE][?config=FILE], got {!r}"
)


def connector(
    server: str,
    *,
    token: str | None = None,
    ca: str | Path | None = None,
    cert: str | Path | None = None,
    key: str | Path | None = None,
) -> "Callable[[], Transport]":
    """Return a function that makes the transport; call it in the event loop that will use it.

    ``zenoh+tls://`` and the like name the link, which is TCP by default. Raises ValueError.
    """
    credentials = Credentials.of(token, ca, cert, key, private=is_private(server))
    scheme, separator, address = server.rpartition("://")
    if scheme in (("grpc", "grpcs") if separator else ("",)) and _is_place(address):
        from vergence.transports.grpc import GrpcTransport

        return partial(
            GrpcTransport,
            address,
            direct=on_this_machine(server),
            secure=scheme == "grpcs",
            credentials=credentials,
        )
    if scheme in ("http", "https") and _is_place(address):
        return _http_connector(server, credentials)
    kind, _, link = scheme.partition("+")
    if kind == "zenoh":
        return _zenoh_connector(server, link or "tcp")
    raise ValueError(_EXPECTED.format(server))


def is_private(server: str) -> bool:
    """Return True if nobody on the way to ``server`` can read what is sent."""
    return server.partition("://")[0] in ("grpcs", "https") or on_this_machine(server)


def on_this_machine(server: str) -> bool:
    """Return True if ``server`` is a loopback address: it costs no network and needs no proxy.

    A Zenoh address is that of a router; the server may be elsewhere.
    """
    scheme, _, address = server.rpartition("://")
    host = (urlsplit(f"//{address}").hostname or "").removesuffix(".")
    if scheme not in ("", "grpc", "grpcs", "http", "https"):
        return False
    try:
        ip = ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")  # RFC 6761
    ip = getattr(ip, "ipv4_mapped", None) or ip
    return ip.is_loopback or ip.is_unspecified


def _zenoh_connector(server: str, link: str) -> "Callable[[], Transport]":
    parts = urlsplit(server)
    options = parse_qs(parts.query, keep_blank_values=True)
    files = options.pop("config", [])
    if not _is_place(parts.netloc) or options or len(files) > 1:
        raise ValueError(_EXPECTED.format(server))
    try:
        from vergence.transports.zenoh import ZenohTransport
    except ImportError:
        raise ValueError(
            f"{server} needs Zenoh, which is not installed here: {how_to_install('zenoh')}"
        ) from None
    return partial(
        ZenohTransport,
        f"{link}/{parts.netloc}",
        parts.path.strip("/") or DEFAULT_NAMESPACE,
        Path(files[0]) if files else None,
    )


def _http_connector(server: str, credentials: Credentials) -> "Callable[[], Transport]":
    try:
        from vergence.transports.http import HttpTransport
    except ImportError:
        raise ValueError(
            f"{server} needs httpx, which is not installed here: {how_to_install('cli')}"
        ) from None
    return partial(HttpTransport, server, credentials=credentials)


def _is_place(address: str) -> bool:
    host, _, port = address.rpartition(":")
    return bool(host) and port.isdecimal()
