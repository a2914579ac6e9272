"""Measure how several live streams share one server. Needs Linux.

    python tests/benchmarks/many_streams.py --json FILE

A real server process runs `lite` on the CPU. For each count of streams there are as many sessions
of the SDK, each with a camera of its own: 640x480, newest wins, over loopback gRPC. They have a
process of their own. Each row has:

- ``hz_sum``: answers to all streams together, per second.
- ``jain``: Jain's index of the streams' rates; 1 means that all are equal.
- ``age_p50_ms age_p99_ms``: time from capture to the moment that a client has the map.
- ``age_ratio``: age_p50 over one step, one frame interval and the transport. The step is the median
  of this row. The transport is the age of a lone stream without its step.
- ``shed``: frames that were not answered with a map, in percent of those that cameras took.
- ``cpu_ms``: CPU time of the server per answer, with transport and codec.

``plain``: the same streams on a loop of 40 lines over the same model, without Vergence's service.
``triton``: the same streams as sequences of Triton's sequence batcher, over the same model in its
Python backend; ``--triton`` names the site-packages of an environment with nvidia-pytriton.
``beside``: what a 30 Hz stream keeps of its fair share beside expensive neighbours. Its fair share
is what it gets beside as many neighbours like itself, measured just before. Each camera has a
process of its own here: what a neighbour's client does is no cost of the service.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vergence import (
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    ImageEncoding,
    Pose,
    RectifiedRig,
)
from vergence_proto.instruction_set import instruction_set
from vergence_service.inference.onnx_model import packaged_weights_dir

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.plain_loop import plain_loop, plain_stream

DISPARITY_PX = 12
STAGGER_S = 0.013  # between the starts of two cameras, which are not synchronous
LEAD_S = 4.0  # cameras run for so long before it counts


Kind = Literal["vergence", "plain", "triton"]


@dataclass(frozen=True, slots=True)
class Camera:
    """What one stream sends."""

    rate_hz: float = 30.0
    width: int = 640
    height: int = 480
    iterations: int = 0  # 0: the server's default
    posed: bool = True
    encoding: ImageEncoding | None = None  # None: the default of a server on this machine, raw
    lossless: bool = False

    @property
    def rig(self) -> RectifiedRig:
        return RectifiedRig(
            self.width, self.height, 0.8 * self.width, 0.8 * self.width,
            (self.width - 1) / 2, (self.width - 1) / 2, (self.height - 1) / 2, 0.1,
        )  # fmt: skip

    def pair(self) -> tuple[Any, Any]:
        shape = (self.height, self.width + DISPARITY_PX, 3)
        noise = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        return noise[:, :-DISPARITY_PX].copy(), noise[:, DISPARITY_PX:].copy()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one stream got in the counted time."""

    ages_s: list[float]
    steps_s: list[float]  # time in the model
    taken: int  # frames that the camera took


# Neighbours of a healthy stream.
LARGE = Camera(width=2048, height=1536)
BESIDE = {
    "1 x 2048x1536": [LARGE],
    "2 x 2048x1536": [LARGE] * 2,
    "2 x 2048x1536 as JPEG": [replace(LARGE, encoding=ImageEncoding.JPEG)] * 2,
    "2 x 64 iterations": [Camera(iterations=64, posed=False)] * 2,
    "2 x lossless": [Camera(lossless=True)] * 2,
}


@dataclass(frozen=True, slots=True)
class Server:
    address: str
    pid: int

    def cpu_s(self) -> float:
        """Return the CPU time of the process and its children until now."""
        ticks = 0
        waiting = [str(self.pid)]
        while waiting:
            about = Path("/proc") / waiting.pop()
            fields = (about / "stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])  # user, system
            for children in about.glob("task/*/children"):
                waiting += children.read_text().split()
        return ticks / os.sysconf("SC_CLK_TCK")


@asynccontextmanager
async def serving(weights: Path, threads: int) -> AsyncIterator[Server]:
    """A real server process, its model loaded."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service"),
        *("--grpc-port", "0", "--http-port", "0", "--threads", str(threads)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={
            **os.environ,
            "VERGENCE_MODEL__WEIGHTS": str(weights),
            "VERGENCE_STREAMS__CAPACITY": "128",
        },
    )
    assert process.stdout is not None
    try:
        _, grpc_address, _ = (await process.stdout.readline()).decode().split()
        await process.stdout.readline()  # every graph is loaded
        yield Server(grpc_address.removeprefix("grpc="), process.pid)
    finally:
        process.terminate()
        await process.wait()


async def stream(address: str, camera: Camera, starts_s: float, counted_s: float) -> Outcome:
    """Run a camera and its reader; return what came in the counted time."""
    left, right = camera.pair()
    ages_s: list[float] = []
    steps_s: list[float] = []

    async def film(session: DepthSession) -> None:
        for index in range(int(camera.rate_hz * (counted_s + LEAD_S))):
            await asyncio.sleep(starts_s - LEAD_S + index / camera.rate_hz - time.monotonic())
            session.submit(left, right, Pose.identity() if camera.posed else None)
        session.end()

    def count(result: DepthResult) -> None:
        if starts_s <= time.monotonic() < starts_s + counted_s:
            ages_s.append((time.monotonic_ns() - result.capture_ns) * 1e-9)
            steps_s.append(result.timings.model_s)

    async with (
        DepthClient(f"grpc://{address}") as client,
        client.open_session(
            camera.rig,
            delivery=Delivery.EVERY if camera.lossless else Delivery.NEWEST,
            encoding=camera.encoding,
            iterations=camera.iterations,
            cold_iterations=camera.iterations,
        ) as session,
    ):
        if camera.lossless:
            while time.monotonic() < starts_s + counted_s:
                count(await session.step(left, right, Pose.identity()))
        else:
            filming = asyncio.create_task(film(session))
            async for result in session:
                count(result)
            await filming
    return Outcome(ages_s, steps_s, int(camera.rate_hz * counted_s))


def in_a_process(
    address: str, cameras: list[Camera], starts_s: float, counted_s: float, kind: Kind
) -> list[Outcome]:
    if kind == "triton":  # its client is of the extra dev
        from tests.support.triton_loop import triton_stream as one
    else:
        one = plain_stream if kind == "plain" else stream

    async def all_of_them() -> list[Outcome]:
        outcomes: list[Outcome] = await asyncio.gather(
            *(
                one(address, camera, starts_s + index * STAGGER_S, counted_s)
                for index, camera in enumerate(cameras)
            )
        )
        return outcomes

    return asyncio.run(all_of_them())


async def apart(server: Server, cameras: list[Camera], *, seconds: float) -> list[float]:
    """Run each camera in a process of its own; return their rates in Hz."""
    starts_s = time.monotonic() + 3.0 + LEAD_S
    with multiprocessing.get_context("spawn").Pool(len(cameras)) as pool:
        loop = asyncio.get_running_loop()
        running = [
            loop.run_in_executor(
                None,
                pool.apply,
                in_a_process,
                (server.address, [each], starts_s, seconds, "vergence"),
            )
            for each in cameras
        ]
        outcomes = [outcome for [outcome] in await asyncio.gather(*running)]
    return [len(each.ages_s) / seconds for each in outcomes]


async def together(
    server: Server, cameras: list[Camera], *, seconds: float, kind: Kind = "vergence"
) -> tuple[list[Outcome], float]:
    """Run the cameras in a process of their own; return also the server's CPU time."""
    starts_s = time.monotonic() + 2.0 + LEAD_S + 0.1 * len(cameras)
    loop = asyncio.get_running_loop()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        running = loop.run_in_executor(
            None, pool.apply, in_a_process, (server.address, cameras, starts_s, seconds, kind)
        )
        await asyncio.sleep(starts_s - time.monotonic())
        before_s = server.cpu_s()
        await asyncio.sleep(starts_s + seconds - time.monotonic())
        cpu_s = server.cpu_s() - before_s
        return await running, cpu_s


def row(
    outcomes: list[Outcome], cpu_s: float, *, seconds: float, rate_hz: float, transport_s: float
) -> dict[str, float]:
    counts = np.array([len(each.ages_s) for each in outcomes])
    ages_s = np.concatenate([each.ages_s for each in outcomes])
    step_s = float(np.median(np.concatenate([each.steps_s for each in outcomes])))
    p50, p99 = np.percentile(ages_s, [50, 99])
    return {
        "hz_sum": counts.sum() / seconds,
        "jain": counts.sum() ** 2 / (len(counts) * (counts**2).sum()),
        "age_p50_ms": 1e3 * p50,
        "age_p99_ms": 1e3 * p99,
        "age_ratio": p50 / (step_s + 1 / rate_hz + transport_s),
        "step_ms": 1e3 * step_s,
        "shed": 100 * (1 - counts.sum() / sum(each.taken for each in outcomes)),
        "cpu_ms": 1e3 * cpu_s / max(counts.sum(), 1),
    }


async def rows_of(server: Server, args: argparse.Namespace, kind: Kind) -> dict[str, Any]:
    offers = {f"{count}": [args.rate_hz] * count for count in args.streams}
    if not args.no_fast:
        offers["2 at 72 and 2 at 15 Hz"] = [72.0, 72.0, 15.0, 15.0]
        offers["72 at 15 Hz"] = [15.0] * 72
    rows: dict[str, Any] = {}
    transport_s = 0.0
    for name, rates in offers.items():
        cameras = [Camera(rate_hz=each) for each in rates]
        # A stream among many has few answers, and so few do not show who gets how much.
        seconds = args.seconds * max(1, len(rates) // 16)
        outcomes, cpu_s = await together(server, cameras, seconds=seconds, kind=kind)
        if len(rates) == 1:
            lone = outcomes[0]
            transport_s = float(np.median(lone.ages_s) - np.median(lone.steps_s))
        rows[name] = row(
            outcomes, cpu_s, seconds=seconds, rate_hz=rates[0], transport_s=transport_s
        )
        show(name if kind == "vergence" else f"{kind} {name}", rows[name])
    return rows


async def rows_beside(server: Server, args: argparse.Namespace) -> dict[str, Any]:
    healthy = Camera(rate_hz=args.rate_hz)
    rows: dict[str, Any] = {}
    for name, neighbours in BESIDE.items():
        fair_hz, *_ = await apart(server, [healthy] * (1 + len(neighbours)), seconds=args.seconds)
        hz, *others_hz = await apart(server, [healthy, *neighbours], seconds=args.seconds)
        kept = {"hz": hz, "fair_hz": fair_hz, "kept": hz / fair_hz, "others_hz": sum(others_hz)}
        rows[name] = kept
        show(f"beside {name}", kept)
    return rows


async def measure(args: argparse.Namespace) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    async with serving(args.weights, args.threads) as server:
        if not args.no_streams:
            figures["streams"] = await rows_of(server, args, "vergence")
        if not args.no_beside:
            figures["beside"] = await rows_beside(server, args)
    if not args.no_plain:
        with plain_loop(args.weights, args.threads) as (address, pid):
            figures["plain"] = await rows_of(Server(address, pid), args, "plain")
    if args.triton is not None:
        from tests.support.triton_loop import triton_loop

        with triton_loop(args.weights, args.threads, args.triton) as (address, pid):
            figures["triton"] = await rows_of(Server(address, pid), args, "triton")
    return figures


def show(name: str, values: dict[str, float]) -> None:
    print(  # noqa: T201
        f"{name:28}" + " ".join(f"{key} {value:.2f}" for key, value in values.items()), flush=True
    )


def rounded(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: rounded(value) for key, value in values.items()}
    return round(float(values), 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--weights", type=Path, default=packaged_weights_dir())
    parser.add_argument("--streams", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--rate-hz", type=float, default=30.0, help="of every camera")
    parser.add_argument(
        "--seconds", type=float, default=8.0, help="that are counted, per row of at most 16 streams"
    )
    parser.add_argument("--threads", type=int, default=2, help="of the model")
    parser.add_argument("--no-plain", action="store_true", help="without the plain loop")
    parser.add_argument("--triton", type=Path, help="site-packages with nvidia-pytriton")
    parser.add_argument("--no-streams", action="store_true", help="without the rows of the service")
    parser.add_argument("--no-beside", action="store_true", help="without expensive neighbours")
    parser.add_argument("--no-fast", action="store_true", help="without the rows of 72 and 15 Hz")
    args = parser.parse_args()
    print(f"isa {instruction_set()}")  # noqa: T201
    figures = rounded(asyncio.run(measure(args)))
    if args.json:
        settings = {key: vars(args)[key] for key in ("rate_hz", "seconds", "threads")}
        settings["isa"] = instruction_set()
        args.json.write_text(json.dumps({**settings, **figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
