"""What keeps a transport from starting: errors for the operator, in one sentence each."""


class PortTaken(OSError):
    """An address cannot be listened on."""

    def __init__(self, address: str, setting: str) -> None:
        super().__init__(
            f"cannot listen on {address}: another server has the port, or the address is not this "
            f"machine's; choose another with {setting}"
        )


class ExtraMissing(ImportError):
    """A setting asks for what is not installed here."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(
            f"{what} is not installed here; install it: pip install 'vergence[{extra}]'"
        )


class ZenohUnreachable(OSError):
    """The Zenoh network cannot be joined as the settings say."""

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"cannot start Zenoh: {reason}; look at zenoh.listen, zenoh.connect and zenoh.config"
        )
