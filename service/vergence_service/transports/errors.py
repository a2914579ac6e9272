"""Errors that keep a transport from starting, each one sentence for the operator."""

from vergence_proto.extras import Extra, how_to_install


class PortTaken(OSError):
    """The server cannot listen on an address."""

    def __init__(self, address: str, setting: str) -> None:
        super().__init__(
            f"cannot listen on {address}: another server uses the port, or the address does not "
            f"belong to this machine; choose another with {setting}"
        )


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
