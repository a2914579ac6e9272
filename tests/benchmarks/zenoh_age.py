"""Measure the age of what a slow consumer sees over Zenoh: our receivers and the default one.

    python tests/benchmarks/zenoh_age.py --json FILE

A map is published at a camera's rate. Each consumer works on a map for longer than a camera's
period, as a headset does that cannot keep up. An age is the time from capture to the moment that a
consumer takes the map. All consumers of maps run side by side, each on a connection of its own to
one publisher in another process.

- ``fifo``: Zenoh's default handler. The age grows for as long as the consumer is slow.
- ``ring``: Zenoh's ring channel with room for one map.
- ``inbox``: the receiver of this project with room for one map, while the consumer's work blocks
  the event loop.
- ``session``: the SDK, from the camera through a real server with its model and back. It runs after
  the others, because it needs the whole machine.

Each row has ``p50_ms p99_ms max_ms``, the median of the first and of the last second
(``first_ms last_ms``), and the number of maps that were taken.
"""

import argparse
import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import DefaultHandler, RingChannel

from vergence import DepthClient, Pose, RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.inbox import Inbox
from vergence_proto.zenoh.keys import StreamKeys, encoding_of
from vergence_proto.zenoh.session import ZenohSession, make_config

KEYS = StreamKeys("vergence", "place", "benchmark")
ATTACHMENT_ID = "benchmark"
MAP_BYTES = 200_000  # a compressed 640x480 map
RIG = RectifiedRig(320, 240, 250.0, 250.0, 159.5, 159.5, 119.5, 0.1)

Ages = list[tuple[float, float]]  # when taken and how old then, both in seconds


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def config(mode: str, endpoint: str) -> zenoh.Config:
    way: dict[str, Any] = {
        "listen__endpoints" if mode == "router" else "connect__endpoints": [endpoint]
    }
    # On one machine large messages go through shared memory, which a headset does not have.
    way["transport__shared_memory__enabled"] = False
    return make_config(max_message_bytes=1 << 24, mode=mode, **way)


def publish(endpoint: str, rate_hz: float, seconds: float) -> None:
    """Runs in a process of its own, until its input ends."""
    with zenoh.open(config("router", endpoint)) as session:
        print("ready", flush=True)  # noqa: T201 -- to the benchmark
        sys.stdin.readline()
        started_s = time.monotonic()
        plane = pb.Plane(data=os.urandom(MAP_BYTES))
        for index in range(int(rate_hz * seconds)):
            time.sleep(max(0.0, started_s + index / rate_hz - time.monotonic()))
            message = pb.DisparityMap(
                frame_id=index + 1, capture_ns=time.monotonic_ns(), disparity=plane
            )
            session.put(
                KEYS.disparity,
                message.SerializeToString(),
                encoding=encoding_of(message),
                attachment=ATTACHMENT_ID,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
        sys.stdin.read()


def age_of(message: pb.DisparityMap) -> tuple[float, float]:
    now_ns = time.monotonic_ns()
    return now_ns * 1e-9, (now_ns - message.capture_ns) * 1e-9


def consume_from_channel(
    endpoint: str,
    channel: "DefaultHandler[zenoh.Sample] | RingChannel[zenoh.Sample]",
    work_s: float,
    until_s: float,
) -> Ages:
    ages: Ages = []
    with (
        zenoh.open(config("client", endpoint)) as session,
        session.declare_subscriber(KEYS.disparity, channel) as subscriber,
    ):
        while time.monotonic() < until_s:
            if (sample := subscriber.try_recv()) is None:
                time.sleep(0.001)
                continue
            ages.append(age_of(pb.DisparityMap.FromString(sample.payload.to_bytes())))
            time.sleep(work_s)
    return ages


async def consume_from_inbox(endpoint: str, work_s: float, until_s: float) -> Ages:
    ages: Ages = []
    peer = ZenohSession(config("client", endpoint))
    await peer.open()
    inbox = Inbox(ATTACHMENT_ID, bulky=pb.DisparityMap, max_bulky=1, drop_oldest=True)
    subscription = await peer.subscribe(KEYS.disparity, inbox.put)
    try:
        async with asyncio.timeout(until_s - time.monotonic()):
            while True:
                message = await inbox.take()
                assert isinstance(message, pb.DisparityMap)
                ages.append(age_of(message))
                time.sleep(work_s)  # noqa: ASYNC251 -- a consumer that blocks its event loop
                await asyncio.sleep(0)
    except TimeoutError:
        await peer.undeclare(subscription)
        await peer.close()
    return ages


def consumers_of_maps(rate_hz: float, work_s: float, seconds: float) -> dict[str, Ages]:
    endpoint = free_endpoint()
    publisher = subprocess.Popen(
        [
            *(sys.executable, __file__, "--publish", endpoint),
            *(f"--rate-hz={rate_hz}", f"--seconds={seconds}"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert publisher.stdin is not None
    assert publisher.stdout is not None
    try:
        publisher.stdout.readline()
        until_s = time.monotonic() + seconds + 0.5
        with ThreadPoolExecutor(3) as threads:
            runs = {
                "fifo": threads.submit(
                    consume_from_channel, endpoint, DefaultHandler(), work_s, until_s
                ),
                "ring": threads.submit(
                    consume_from_channel, endpoint, RingChannel(1), work_s, until_s
                ),
                "inbox": threads.submit(asyncio.run, consume_from_inbox(endpoint, work_s, until_s)),
            }
            time.sleep(0.5)  # until all of them have subscribed
            publisher.stdin.write("go\n")
            publisher.stdin.flush()
            return {name: run.result() for name, run in runs.items()}
    finally:
        publisher.kill()
        publisher.wait()


async def consume_session(rate_hz: float, work_s: float, seconds: float) -> Ages:
    endpoint = free_endpoint()
    server = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service", "--zenoh"),
        *("--grpc-port", "0", "--http-port", "0"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "VERGENCE_ZENOH__LISTEN": json.dumps([endpoint])},
    )
    assert server.stdout is not None
    await server.stdout.readline()
    ages: Ages = []
    image = np.random.default_rng(0).integers(0, 256, (RIG.height, RIG.width + 8), np.uint8)
    left, right = image[:, :-8].copy(), image[:, 8:].copy()
    try:
        async with (
            DepthClient(endpoint.replace("tcp/", "zenoh://")) as client,
            client.open_session(RIG) as session,
        ):

            async def film() -> None:
                started_s = time.monotonic()
                for index in range(int(rate_hz * seconds)):
                    await asyncio.sleep(started_s + index / rate_hz - time.monotonic())
                    session.submit(left, right, Pose.identity())
                session.end()

            camera = asyncio.create_task(film())
            async for result in session:
                now_ns = time.monotonic_ns()
                ages.append((now_ns * 1e-9, (now_ns - result.capture_ns) * 1e-9))
                await asyncio.sleep(work_s)
            await camera
    finally:
        server.terminate()
        await server.wait()
    return ages


def summary(ages: Ages) -> dict[str, float]:
    taken_s, age_ms = np.array(ages)[:, 0], np.array(ages)[:, 1] * 1e3
    return {
        "p50_ms": float(np.percentile(age_ms, 50)),
        "p99_ms": float(np.percentile(age_ms, 99)),
        "max_ms": float(age_ms.max()),
        "first_ms": float(np.median(age_ms[taken_s < taken_s[0] + 1])),
        "last_ms": float(np.median(age_ms[taken_s > taken_s[-1] - 1])),
        "taken": len(ages),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rate-hz", type=float, default=60.0)
    parser.add_argument("--work-ms", type=float, default=50.0, help="of a consumer, on each map")
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--publish", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.publish:
        publish(chosen.publish, chosen.rate_hz, chosen.seconds)
        return
    work_s = chosen.work_ms * 1e-3
    rows = consumers_of_maps(chosen.rate_hz, work_s, chosen.seconds)
    rows["session"] = asyncio.run(consume_session(chosen.rate_hz, work_s, chosen.seconds))
    figures = {name: summary(ages) for name, ages in rows.items()}
    columns = list(figures["fifo"])
    print(f"isa {instruction_set()}")  # noqa: T201
    print(f"{'':8}" + "".join(f"{name:>10}" for name in columns))  # noqa: T201
    for name, row in figures.items():
        print(f"{name:8}" + "".join(f"{row[column]:10.1f}" for column in columns))  # noqa: T201
    if chosen.json:
        settings = {key: vars(chosen)[key] for key in ("rate_hz", "work_ms", "seconds")}
        settings["isa"] = instruction_set()
        chosen.json.write_text(json.dumps({**settings, "consumers": figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()
