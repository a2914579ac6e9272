"""The real server with the tiny model, in a process of its own: ``python -m`` this module."""

import asyncio
import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

from tests.support.models import RecallModel
from tests.support.server import running_server

_REPOSITORY = Path(__file__).parents[2]


async def _serve() -> None:
    async with running_server(RecallModel(), **json.loads(sys.argv[1])) as server:
        print(server.grpc_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


@contextmanager
def recall_server_process(**flags: Any) -> Iterator[tuple[str, Popen[str]]]:
    """Its address and its process, for the length of the block; flags as for ``running_server``.

    The block may kill it.
    """
    command = [sys.executable, "-m", "tests.support.server_process", json.dumps(flags)]
    with Popen(command, cwd=_REPOSITORY, stdin=PIPE, stdout=PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address, "the server did not start"
        yield address, process
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=20) in (0, -signal.SIGKILL)


@contextmanager
def recall_server() -> Iterator[str]:
    """Its address, for the length of the block."""
    with recall_server_process() as (address, _):
        yield address


if __name__ == "__main__":
    asyncio.run(_serve())
