"""Open sessions one after the other over a link; note how many open, and how soon.

``python -m`` this module does it in a process of its own: {"server", "count"} as JSON.
"""

import asyncio
import json
import sys
import time
from statistics import median
from typing import Any

from tests.support.frames import RIG, make_frame
from vergence import DepthClient, DepthSession


async def openings(server: str, count: int) -> dict[str, Any]:
    """Open ``count`` sessions, and wait for one result of each."""
    opened_s, errors = [], []
    for _ in range(count):
        began_s = time.monotonic()
        try:
            async with DepthClient(server) as client, client.open_session(RIG) as session:
                took_s = time.monotonic() - began_s
                async with asyncio.timeout(20):
                    await _first_result(session)
            opened_s.append(took_s)
        except Exception as error:
            errors.append(f"{type(error).__name__}: {error}")
    return {
        "opened": len(opened_s),
        "tried": count,
        "open_p50_s": round(median(opened_s), 2) if opened_s else None,
        "open_max_s": round(max(opened_s), 2) if opened_s else None,
        "errors": errors,
    }


async def _first_result(session: DepthSession) -> None:
    """Submit frames as a camera does until one has a result; over Zenoh a live one may be lost."""
    waiting = asyncio.create_task(anext(session))
    while not waiting.done():
        frame = make_frame(1)
        session.submit(frame.left, frame.right, frame.pose)
        await asyncio.wait({waiting}, timeout=0.1)
    await waiting


if __name__ == "__main__":
    print(json.dumps(asyncio.run(openings(**json.loads(sys.argv[1])))))  # noqa: T201
