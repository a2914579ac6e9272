"""The real server with the tiny model, in a process of its own: ``python -m`` this module."""

import asyncio
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen

from tests.support.models import RecallModel
from tests.support.server import running_server

_REPOSITORY = Path(__file__).parents[2]


async def _serve() -> None:
    async with running_server(RecallModel()) as server:
        print(server.grpc_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


@contextmanager
def recall_server() -> Iterator[str]:
    """Its address, for the length of the block."""
    command = [sys.executable, "-m", "tests.support.server_process"]
    with Popen(command, cwd=_REPOSITORY, stdin=PIPE, stdout=PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address, "the server did not start"
        yield address
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=20) == 0


if __name__ == "__main__":
    asyncio.run(_serve())
