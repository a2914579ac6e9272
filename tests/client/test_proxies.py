"""A web proxy in the environment: servers on this machine do without it, others go through it."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.support.frames import RIG, make_frame
from vergence import ConnectionLost, DepthClient
from vergence.transports.proxies import through_proxy
from vergence_service.app.server import Running

NAMES = ("http_proxy", "https_proxy", "all_proxy", "grpc_proxy", "no_proxy", "no_grpc_proxy")
NOBODY = "http://127.0.0.1:9"


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)


@pytest.mark.parametrize("transport", ["grpc", "http"])
@pytest.mark.parametrize("proxy", [NOBODY, "socks5://127.0.0.1:9", "nonsense"])
async def test_a_server_on_this_machine_needs_no_proxy(
    transport: str, proxy: str, server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "https_proxy", "grpc_proxy", "ALL_PROXY", "HTTP_PROXY"):
        monkeypatch.setenv(name, proxy)
    address = getattr(server, f"{transport}_address").replace("127.0.0.1", "localhost")
    frame = make_frame(1)
    async with (
        DepthClient(f"{transport}://{address}") as client,
        client.open_session(RIG) as session,
    ):
        assert (await session.step(frame.left, frame.right)).frame_id == 1
        assert (await client.server_info()).streams_open == 1


@pytest.fixture
async def connects() -> AsyncIterator[tuple[str, list[bytes]]]:
    """A proxy that refuses, and the first lines of what it was asked."""
    asked: list[bytes] = []

    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append(await reader.readline())
        writer.write(b"HTTP/1.1 403 Forbidden\r\ncontent-length: 0\r\n\r\n")
        writer.close()

    async with await asyncio.start_server(refuse, "127.0.0.1", 0) as listening:
        yield f"http://127.0.0.1:{listening.sockets[0].getsockname()[1]}", asked


@pytest.mark.parametrize("scheme", ["grpc", "http", "https"])
async def test_a_server_elsewhere_goes_through_it_and_a_failure_says_so(
    scheme: str, connects: tuple[str, list[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    proxy, asked = connects
    name = {"grpc": "http_proxy", "http": "HTTP_PROXY", "https": "all_proxy"}[scheme]
    monkeypatch.setenv(name, proxy)
    async with DepthClient(f"{scheme}://depth.example:50051") as client:
        with pytest.raises(Exception, match=f"through the proxy of {name}={proxy}") as caught:
            await client.server_info()
    assert "no_proxy=depth.example" in str(caught.value)
    assert b"depth.example:50051" in asked[0]


async def test_no_proxy_is_heeded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", NOBODY)
    monkeypatch.setenv("no_proxy", "depth.example,10.0.0.1")
    assert "proxy" in through_proxy("grpc://elsewhere.example:1")
    assert through_proxy("grpc://depth.example:1") == ""
    assert through_proxy("http://depth.example:1") == ""


@pytest.mark.parametrize("proxy", ["socks5://127.0.0.1:9", "nonsense"])
async def test_a_proxy_that_cannot_be_used_is_reported(
    proxy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ALL_PROXY", proxy)
    with pytest.raises(ConnectionLost, match="through the proxy of ALL_PROXY"):
        async with DepthClient("http://depth.example:8000") as client:
            await client.server_info()


def test_the_health_check_of_the_image_needs_no_proxy() -> None:
    dockerfile = (Path(__file__).parents[2] / "docker" / "Dockerfile").read_text()
    check = next(line for line in dockerfile.splitlines() if "/readyz" in line)
    assert "ProxyHandler({})" in check
