"""Measure what snapshots of streams cost: bytes, time of this server, and time of Redis.

    apt-get install redis-server
    python tests/benchmarks/snapshot_cost.py --json FILE

A real Redis runs on this machine. For each size of images, ``lite`` takes two steps, and the state
after them is written and claimed ``--count`` times, one after the other. Medians, milliseconds:

- ``state_mb``: bytes of a snapshot, in MB.
- ``step_ms``: one warm step, for comparison. ``serialise_ms``: the snapshot as bytes, in a thread
  beside the frames. ``save_ms`` and ``claim_ms``: the calls of Redis, until the answer.
- ``redis_cpu_ms``: CPU time of Redis for one save. ``saves_per_core``: saves a second that would
  fill one core of Redis, which has one thread for all of them.
"""

import argparse
import asyncio
import json
import statistics
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_proto.types import Origin
from vergence_service.app.server import make_model
from vergence_service.inference.model import RecurrentState, Step, StereoModel, StereoView
from vergence_service.settings import load_settings
from vergence_service.snapshots.redis_store import RedisStore
from vergence_service.snapshots.snapshot import StreamSnapshot
from vergence_service.snapshots.store import Claimed, Owner, Saved

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.redis_server import RedisServer, redis_server

SIZES = ((320, 240), (640, 480), (1280, 720), (1920, 1080))


def stepped(
    model: StereoModel, width: int, height: int, count: int
) -> tuple[RecurrentState, float]:
    """Return a state after warm steps, and the median time of one, in milliseconds."""
    rig = RectifiedRig(
        width, height, 0.8 * width, 0.8 * width, width / 2, width / 2, height / 2, 0.1
    )
    noise = np.random.default_rng(0).integers(0, 256, (height, width + 12, 3), np.uint8)
    left, right = noise[:, 12:].copy(), noise[:, :-12].copy()
    state: RecurrentState | None = None
    times_ms = []
    for number in range(count):
        pose = Pose(np.eye(3), np.array([0.01 * number, 0.0, 0.0]))
        view = StereoView(left, right, rig, number * 100_000_000, pose)
        began_s = time.perf_counter()
        [result] = model.step([Step(view, state, 1)])
        times_ms.append(1000 * (time.perf_counter() - began_s))
        state = result.state
    assert state is not None
    return state, statistics.median(times_ms[1:])


async def median_ms(count: int, work: Callable[[int], Awaitable[object]]) -> float:
    times_ms = []
    for number in range(count):
        began_s = time.perf_counter()
        await work(number)
        times_ms.append(1000 * (time.perf_counter() - began_s))
    return statistics.median(times_ms)


async def row_of(
    model: StereoModel, server: RedisServer, width: int, height: int, count: int
) -> dict[str, Any]:
    state, step_ms = stepped(model, width, height, 8)
    snapshot = StreamSnapshot(8, model.card.weights_sha256, Origin.WARM, state)
    value = snapshot.to_bytes()
    saved = Saved("local/camera", value, "token", "rig", 60.0)
    store = RedisStore(server.url, timeout_s=5.0)

    async def serialise(_: int) -> None:
        snapshot.to_bytes()

    async def save(_: int) -> None:
        await store.save(saved, Owner("a"), takes_over=True)

    async def claim(number: int) -> None:
        found = await store.claim(
            "local/camera", Owner(f"b{number}"), token_digest="token", rig_digest="rig"
        )
        assert isinstance(found, Claimed)

    def redis_cpu_s() -> float:
        used = server.admin.info("cpu")
        return float(used["used_cpu_user"]) + float(used["used_cpu_sys"])

    try:
        await save(0)  # connects, and sends the script
        before_s = redis_cpu_s()
        save_ms = await median_ms(count, save)
        cpu_ms = 1000 * (redis_cpu_s() - before_s) / count
        return {
            "size": f"{width}x{height}",
            "state_mb": round(len(value) / 1e6, 3),
            "step_ms": round(step_ms, 2),
            "serialise_ms": round(await median_ms(count, serialise), 2),
            "save_ms": round(save_ms, 2),
            "claim_ms": round(await median_ms(count, claim), 2),
            "redis_cpu_ms": round(cpu_ms, 3),
            "saves_per_core": round(1000 / cpu_ms) if cpu_ms else None,
        }
    finally:
        await store.close()


async def run(count: int) -> list[dict[str, Any]]:
    model = make_model(load_settings(flags={"model.threads": 1}))
    rows = []
    with redis_server() as server:
        for width, height in SIZES:
            rows.append(await row_of(model, server, width, height, count))
            print(rows[-1], flush=True)  # noqa: T201  a program
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--count", type=int, default=200)
    options = parser.parse_args()
    rows = asyncio.run(run(options.count))
    report = {"instruction_set": instruction_set(), "rows": rows}
    options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
