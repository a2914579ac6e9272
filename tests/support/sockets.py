"""Free ports."""

import socket


def free_port() -> int:
    """Return a port that nobody listens on; for servers that must be restarted at one address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
