"""Errors that keep a transport from starting, each one sentence for the operator."""

import errno

from vergence_proto.extras import Extra, how_to_install


class PortTaken(OSError):
    """The server cannot listen on an address. ``transport`` is ``grpc`` or ``http``."""

    def __init__(self, address: str, transport: str, error: OSError) -> None:
        if error.errno == errno.EADDRINUSE:
            why = (
                "another server uses this port; use that server, or give this one free ports with "
                "--grpc-port 0 --http-port 0"
            )
        else:
            why = (
                f"{error.strerror or error}; choose another address with --host, or another port "
                f"with --{transport}-port"
            )
        super().__init__(f"cannot listen on {address} ({transport}.port): {why}")
        self.errno = error.errno


class ExtraMissing(ImportError):
    """A setting needs a package that is not installed."""

    def __init__(self, what: str, extra: Extra) -> None:
        super().__init__(f"{what} is not installed; install it: {how_to_install(extra)}")


class ZenohUnreachable(OSError):
    """The server cannot join the Zenoh network that the settings name."""

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"cannot start Zenoh: {reason}; check zenoh.listen, zenoh.connect and zenoh.config"
        )
