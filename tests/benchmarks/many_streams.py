"""Measure how many steps a server takes for several live streams at once. Needs Linux.

    python tests/benchmarks/many_streams.py --json FILE

A real server process runs `lite` on the CPU. For each count of streams there are as many sessions
of the SDK, each with a camera of its own: 640x480, newest wins, over loopback gRPC. Each row has:

- ``steps_per_s``: answers to all streams together.
- ``p50_ms p95_ms``: time from capture to the moment that a client has the map, over all streams.
- ``least_pct``: the answers to the stream that got the fewest, in percent of an equal share.
- ``cpu_ms``: CPU time of the server per step, with transport and codec.
"""

import argparse
import asyncio
import json
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vergence import DepthClient, DepthSession, Pose, RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_service.inference.onnx_model import packaged_weights_dir

RIG = RectifiedRig(640, 480, 500.0, 500.0, 319.5, 319.5, 239.5, 0.1)
DISPARITY_PX = 12
STAGGER_S = 0.013  # between the starts of two cameras, which are not synchronous


@dataclass(frozen=True, slots=True)
class Server:
    address: str
    pid: int

    def cpu_s(self) -> float:
        """Return the CPU time of all its threads until now."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # user, system


@asynccontextmanager
async def serving(weights: Path, threads: int) -> AsyncIterator[Server]:
    """A real server process, its model loaded."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service"),
        *("--grpc-port", "0", "--http-port", "0", "--threads", str(threads)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "VERGENCE_MODEL__WEIGHTS": str(weights)},
    )
    assert process.stdout is not None
    try:
        _, grpc_address, _ = (await process.stdout.readline()).decode().split()
        yield Server(grpc_address.removeprefix("grpc="), process.pid)
    finally:
        process.terminate()
        await process.wait()


async def stream(address: str, *, rate_hz: float, starts_s: float, counted_s: float) -> list[float]:
    """Run a camera and its reader; return the ages in seconds of the maps of the counted time."""
    noise = np.random.default_rng(0).integers(0, 256, (480, 640 + DISPARITY_PX, 3), np.uint8)
    left, right = noise[:, :-DISPARITY_PX].copy(), noise[:, DISPARITY_PX:].copy()
    ages_s: list[float] = []

    async def film(session: DepthSession) -> None:
        for index in range(int(rate_hz * (counted_s + 1.0))):
            await asyncio.sleep(starts_s - 1.0 + index / rate_hz - time.monotonic())
            session.submit(left, right, Pose.identity())
        session.end()

    async with DepthClient(f"grpc://{address}") as client, client.open_session(RIG) as session:
        camera = asyncio.create_task(film(session))
        async for result in session:
            now_s = time.monotonic()
            if starts_s <= now_s < starts_s + counted_s:
                age_s = (time.monotonic_ns() - result.capture_ns) * 1e-9
                ages_s.append(age_s)
        await camera
    return ages_s


async def together(
    server: Server, count: int, *, rate_hz: float, seconds: float
) -> dict[str, float]:
    starts_s = time.monotonic() + 1.5  # before it, streams open and warm up for a second
    async with asyncio.TaskGroup() as tasks:
        streams = [
            tasks.create_task(
                stream(
                    server.address,
                    rate_hz=rate_hz,
                    starts_s=starts_s + index * STAGGER_S,
                    counted_s=seconds,
                )
            )
            for index in range(count)
        ]
        await asyncio.sleep(starts_s - time.monotonic())
        before_s = server.cpu_s()
        await asyncio.sleep(starts_s + seconds - time.monotonic())
        cpu_s = server.cpu_s() - before_s
    ages_s = [task.result() for task in streams]
    steps = sum(map(len, ages_s))
    p50, p95 = np.percentile(np.concatenate(ages_s), [50, 95])
    return {
        "steps_per_s": steps / seconds,
        "p50_ms": 1e3 * p50,
        "p95_ms": 1e3 * p95,
        "least_pct": 100 * min(map(len, ages_s)) * count / steps,
        "cpu_ms": 1e3 * cpu_s / steps,
    }


async def measure(args: argparse.Namespace) -> dict[int, dict[str, float]]:
    async with serving(args.weights, args.threads) as server:
        return {
            count: await together(server, count, rate_hz=args.rate_hz, seconds=args.seconds)
            for count in args.streams
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--weights", type=Path, default=packaged_weights_dir())
    parser.add_argument("--streams", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--rate-hz", type=float, default=30.0, help="of every camera")
    parser.add_argument("--seconds", type=float, default=8.0, help="that are counted, per count")
    parser.add_argument("--threads", type=int, default=2, help="of the model")
    args = parser.parse_args()
    figures = {
        str(count): {name: round(float(value), 2) for name, value in row.items()}
        for count, row in asyncio.run(measure(args)).items()
    }
    columns = list(next(iter(figures.values())))
    print(f"isa {instruction_set()}")  # noqa: T201
    print("streams" + "".join(f"{name:>13}" for name in columns))  # noqa: T201
    for count, row in figures.items():
        print(f"{count:7}" + "".join(f"{row[name]:13.2f}" for name in columns))  # noqa: T201
    if args.json:
        settings = {key: vars(args)[key] for key in ("rate_hz", "seconds", "threads")}
        settings["isa"] = instruction_set()
        args.json.write_text(json.dumps({**settings, "streams": figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
