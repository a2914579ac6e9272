"""Transports translate, and nothing else: bytes to values, errors to statuses, calls to calls."""


class PortTaken(OSError):
    """An address cannot be listened on."""

    def __init__(self, address: str, setting: str) -> None:
        super().__init__(
            f"cannot listen on {address}: another server has the port, or the address is not this "
            f"machine's; choose another with {setting}"
        )
