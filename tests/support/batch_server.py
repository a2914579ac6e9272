"""A server to be killed: ``python -m`` this module, its jobs' folder, seconds of a step, port."""

import asyncio
import sys
from typing import Any

from tests.support.models import PacedModel
from tests.support.server import running_server


async def _serve(directory: str, step_s: float, port: int) -> None:
    flags: dict[str, Any] = {
        "batch__directory": directory,
        "batch__checkpoint_s": 0.1,
        "http__port": port,
    }
    async with running_server(PacedModel(step_s), **flags) as server:
        print(server.http_address, server.admin_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1], float(sys.argv[2]), int(sys.argv[3])))
