"""Network addresses: as text, and bound to a socket."""

import socket

from vergence_service.transports.errors import PortTaken


def format_address(host: str, port: int) -> str:
    """Return HOST:PORT, with an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def listening_socket(host: str, port: int, *, transport: str) -> socket.socket:
    """Return a socket that listens on the address; port 0 is a free one. Raises PortTaken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise PortTaken(format_address(host, port), transport, error) from None
