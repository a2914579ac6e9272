"""A server to be killed: ``python -m`` this module and the folder of its jobs."""

import asyncio
import sys
import time
from collections.abc import Sequence

from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence_service.model import Step, StepResult

_STEP_S = 0.004  # so that a batch lasts long enough to be interrupted


class PacedModel(RecallModel):
    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        time.sleep(_STEP_S)
        return super().step(steps)


async def _serve(directory: str) -> None:
    async with running_server(PacedModel(), batch__directory=directory) as server:
        print(server.http_address, flush=True)  # noqa: T201  the parent reads it
        await asyncio.to_thread(sys.stdin.read)  # until the parent closes its end


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1]))
