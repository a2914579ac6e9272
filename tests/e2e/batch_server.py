"""A server to be killed: ``python -m`` this module, its jobs' folder, seconds of a step, port."""

import asyncio
import sys
import time
from collections.abc import Sequence
from typing import Any

from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence_service.model import Step, StepResult


class PacedModel(RecallModel):
    def __init__(self, step_s: float) -> None:
        super().__init__()
        self._step_s = step_s

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        time.sleep(self._step_s)
        return super().step(steps)


async def _serve(directory: str, step_s: float, port: int) -> None:
    flags: dict[str, Any] = {"batch__directory": directory, "http__port": port}
    async with running_server(PacedModel(step_s), **flags) as server:
        print(server.http_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1], float(sys.argv[2]), int(sys.argv[3])))
