"""A server to be killed: ``python -m`` this module, the folder of its jobs, seconds of a step."""

import asyncio
import sys
import time
from collections.abc import Sequence

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


async def _serve(directory: str, step_s: float) -> None:
    async with running_server(PacedModel(step_s), batch__directory=directory) as server:
        print(server.http_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1], float(sys.argv[2])))
