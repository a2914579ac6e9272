"""A Zenoh network on loopback: free ports, and a router in a process of its own."""

import asyncio
import json
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh

_PATIENCE_S = 20.0


def free_endpoint() -> str:
    """Zenoh does not report the port that it was given, so one is chosen here."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def address_of(endpoint: str) -> str:
    """As a client names it."""
    return endpoint.replace("tcp/", "zenoh://")


class Router:
    """A Zenoh router, which can be killed and started again at its endpoint."""

    def __init__(self, endpoint: str, settings: dict[str, Any]) -> None:
        self.endpoint = endpoint
        self.address = address_of(endpoint)
        self._settings = settings

    async def start(self) -> None:
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, str(Path(__file__)), self.endpoint, json.dumps(self._settings)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        assert self._process.stdout is not None
        ready = await asyncio.wait_for(self._process.stdout.readline(), _PATIENCE_S)
        assert ready == b"ready\n"

    async def kill(self) -> None:
        with suppress(ProcessLookupError):
            self._process.kill()
        await self._process.wait()


@asynccontextmanager
async def router(**settings: Any) -> AsyncIterator[Router]:
    """Settings are Zenoh's, with ``__`` for the slash."""
    started = Router(free_endpoint(), settings)
    await started.start()
    try:
        yield started
    finally:
        await started.kill()


def _main(endpoint: str, settings: str) -> None:
    config = zenoh.Config()
    values = {
        "mode": "router",
        "listen__endpoints": [endpoint],
        "scouting__multicast__enabled": False,
        "scouting__delay": 0,
        **json.loads(settings),
    }
    for key, value in values.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    with zenoh.open(config):
        print("ready", flush=True)  # noqa: T201 -- to the test that started it
        sys.stdin.read()  # until the test ends, even if it is killed


if __name__ == "__main__":
    _main(*sys.argv[1:])
