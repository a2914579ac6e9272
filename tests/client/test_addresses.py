"""What the address of a server says."""

import pytest

from vergence.transports.addresses import on_this_machine


@pytest.mark.parametrize(
    ("server", "here"),
    [
        ("127.0.0.1:50051", True),
        ("grpc://localhost:50051", True),
        ("grpc://127.8.0.1:50051", True),
        ("grpc://[::1]:50051", True),
        ("http://127.0.0.1:8000", True),
        ("grpc://192.0.2.7:50051", False),
        ("https://depth.example:443", False),
        ("zenoh://127.0.0.1:7447", False),  # the router is here; the server may be anywhere
    ],
)
def test_a_loopback_address_is_this_machine(server: str, here: bool) -> None:
    assert on_this_machine(server) is here
