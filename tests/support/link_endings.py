"""End sessions while a frame is on its way; note every error that reaches the program.

``python -m`` this module does it in a process of its own: {"server", "count"} as JSON.
"""

import asyncio
import json
import sys
import time
from collections import Counter
from typing import Any

import numpy as np

from vergence import DepthClient, DepthSession, ImageEncoding, RectifiedRig

_RIG = RectifiedRig(320, 240, 250.0, 250.0, 159.5, 159.5, 119.5, 0.1)
_PAUSES_S = (0.0, 0.01, 0.03, 0.06)  # from submitting to the end: the frame is elsewhere each time


async def endings(server: str, count: int) -> dict[str, Any]:
    """End ``count`` sessions."""
    errors: Counter[str] = Counter()
    began_s = time.monotonic()
    results = 0
    async with DepthClient(server) as client:
        for index in range(count):
            try:
                session = client.open_session(_RIG, encoding=ImageEncoding.RAW, link="fixed")
                async with session:
                    reading = asyncio.create_task(_read(session))
                    image = np.full((240, 320, 3), index % 200, np.uint8)
                    session.submit(image, image)
                    await asyncio.sleep(_PAUSES_S[index % len(_PAUSES_S)])
                    if index % 2:
                        session.end()
                results += await reading
            except Exception as error:
                errors[f"{type(error).__name__}: {error}"] += 1
    took_s = time.monotonic() - began_s
    return {
        "ended": count,
        "errors": dict(errors),
        "results": results,
        "each_s": round(took_s / count, 2),
    }


async def _read(session: DepthSession) -> int:
    return len([result async for result in session])


if __name__ == "__main__":
    print(json.dumps(asyncio.run(endings(**json.loads(sys.argv[1])))))  # noqa: T201
