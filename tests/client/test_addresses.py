"""Server addresses, as they are written."""

import pytest

from vergence import DepthClient
from vergence.transports.addresses import on_this_machine


@pytest.mark.parametrize(
    ("server", "here"),
    [
        ("127.0.0.1:50051", True),
        ("grpc://localhost:50051", True),
        ("grpc://127.8.0.1:50051", True),
        ("grpc://[::1]:50051", True),
        ("grpc://[::ffff:127.0.0.1]:50051", True),
        ("http://LOCALHOST:8000", True),
        ("http://robot.localhost.:8000", True),
        ("0.0.0.0:50051", True),
        ("[::]:50051", True),
        ("grpc://localhost.example:50051", False),
        ("http://127.0.0.1:8000", True),
        ("grpc://192.0.2.7:50051", False),
        ("https://depth.example:443", False),
        ("zenoh://127.0.0.1:7447", False),  # the router is here; the server may be anywhere
    ],
)
def test_a_loopback_address_is_this_machine(server: str, here: bool) -> None:
    assert on_this_machine(server) is here


@pytest.mark.parametrize("server", ["ftp://host:80", "host", ":50051", "grpc://", "host:port"])
def test_a_server_that_is_none_is_refused_by_its_spelling(server: str) -> None:
    with pytest.raises(ValueError, match=r"grpc://HOST:PORT"):
        DepthClient(server)
