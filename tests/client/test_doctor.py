"""What `vergence doctor` says of the ports: whose they are."""

import io
import socket

import pytest
from rich.console import Console

from vergence.cli import doctor as doctor_module
from vergence.cli.doctor import doctor
from vergence_service.app.server import Running


async def printed(server: str) -> str:
    text = io.StringIO()
    await doctor(server, Console(file=text, width=200))
    return text.getvalue()


async def test_the_ports_of_a_running_server_are_distinguished_from_those_of_others(
    server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    grpc, http = (
        int(address.rpartition(":")[2]) for address in (server.grpc_address, server.http_address)
    )
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        ports = {grpc: "gRPC", http: "HTTP", taken: "other"}
        monkeypatch.setattr(doctor_module, "_PORTS", ports)
        lines = (await printed(server.grpc_address)).splitlines()
    for port in (grpc, http):
        assert any(f"127.0.0.1:{port}: a Vergence server" in line for line in lines)
    assert any(f"127.0.0.1:{taken} is taken by another program" in line for line in lines)
