"""Measure whole sequences over HTTP, against the bare model loop and beside a live stream.

    python tests/benchmarks/batch_throughput.py --json FILE

Every round measures each of these once on the same sequence, so that a busy moment of the machine
hits all of them. The benchmark prints medians.

- ``bare_fps``: frames per second of a loop in this process, which reads a frame from disk, steps it
  and goes on to the next.
- ``memory_fps``: the same loop with all frames in memory. The model cannot be faster.
- ``batch_fps``: frames per second of sequences in the queue of a real server process, from the
  first frame of the first sequence to the last of the last. All results are written to disk.
- ``ratio``: batch_fps / bare_fps; ``memory_ratio``: batch_fps / memory_fps.
- ``live_age_p95_ms``: time from capture to result in a 15 Hz live stream over gRPC while the server
  works through a batch. ``..._alone_...`` is without a batch. ``..._first_half_...`` and
  ``..._second_half_...`` show whether it grows. ``live_batch_fps`` is what the batch got beside it.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from statistics import median
from typing import Any

import httpx
import numpy as np

from vergence import DepthClient
from vergence.cli.demo import bundled_sample
from vergence.jobs.packing import Upload
from vergence_proto.datasets import SourceFrame, StereoSource, open_source
from vergence_proto.geometry import RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_proto.types import StereoRig
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import packaged_weights_dir

LIVE_HZ = 15.0
SEQUENCES = 2  # in the queue at once


class BareLoop:
    """Steps the model in a loop, as a script would that has the frames."""

    def __init__(self, rig: StereoRig, threads: int) -> None:
        rectified = rig.as_rectified()
        assert rectified is not None, "the bare loop does not rectify"
        self._rig: RectifiedRig = rectified
        self._model = load_model(
            packaged_weights_dir(),
            "lite",
            engine="auto",  # the one that the server takes
            providers=["cpu"],
            threads=threads,
            allow_spinning=False,
        )
        self._model.warm_up(1, self._iterations(None))

    def fps(self, frames: StereoSource | list[SourceFrame]) -> float:
        state: RecurrentState | None = None
        started_s = time.perf_counter()
        for source in frames:
            frame = source.frame
            assert frame.pose is not None
            pose = frame.pose.world_from_left
            view = StereoView(frame.left, frame.right, self._rig, frame.capture_ns, pose)
            [result] = self._model.step([Step(view, state, self._iterations(state))])
            state = result.state
        return len(frames) / (time.perf_counter() - started_s)

    def _iterations(self, state: RecurrentState | None) -> int:
        return self._model.card.iterations_at_most(8 if state is None else 1)


@asynccontextmanager
async def serving(threads: int, jobs: str) -> AsyncIterator[tuple[str, str]]:
    """A real server process; yields its gRPC and HTTP addresses."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service"),
        *("--grpc-port", "0", "--http-port", "0", "--threads", str(threads)),
        env={**os.environ, "VERGENCE_BATCH__DIRECTORY": jobs},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None
    try:
        _, grpc, http, *_ = (await process.stdout.readline()).decode().split()
        yield grpc.removeprefix("grpc="), http.removeprefix("http=")
    finally:
        process.terminate()
        await process.wait()


async def submit(http: httpx.AsyncClient, archive: bytes) -> str:
    headers = {"Content-Type": "application/zip"}
    answer = await http.post("/v1/sequences", content=archive, headers=headers)
    answer.raise_for_status()
    job_id: str = answer.json()["id"]
    return job_id


async def batch_fps(http: httpx.AsyncClient, archive: bytes, frames: int) -> float:
    """Measure sequences that wait in the queue; they are uploaded before the clock starts."""
    warm = await submit(http, archive)  # the model is busy with it while the others are uploaded
    job_ids = [await submit(http, archive) for _ in range(SEQUENCES)]
    await ended(http, warm)
    started_s = time.perf_counter()
    await ended(http, job_ids[-1])
    seconds = time.perf_counter() - started_s
    for job_id in (warm, *job_ids):
        await http.delete(f"/v1/sequences/{job_id}")
    return SEQUENCES * frames / seconds


async def ended(http: httpx.AsyncClient, job_id: str) -> dict[str, Any]:
    """Wait for the job's end, and return its last state."""
    job: dict[str, Any] = {}
    async with http.stream("GET", f"/v1/sequences/{job_id}/events") as events:
        async for line in events.aiter_lines():
            if line.startswith("data: "):
                job = json.loads(line.removeprefix("data: "))
    assert job["state"] == "done", job
    return job


async def live_ages_s(
    server: str, rig: StereoRig, frames: list[SourceFrame], seconds: float
) -> list[float]:
    """Return the age of each answered frame of a live stream, in order."""
    pairs = [(each.frame.left, each.frame.right, each.frame.pose) for each in frames]
    async with DepthClient(f"grpc://{server}") as client, client.open_session(rig) as session:
        await session.step(*pairs[0])  # the cold start is not measured

        async def film() -> None:
            started_s = time.monotonic()
            for index in range(round(seconds * LIVE_HZ)):
                await asyncio.sleep(started_s + index / LIVE_HZ - time.monotonic())
                session.submit(*pairs[index % len(pairs)])
            await asyncio.sleep(2 / LIVE_HZ)
            session.end()

        camera = asyncio.create_task(film())
        ages_s = [result.age_s async for result in session]
        await camera
    return ages_s


def p95_ms(ages_s: list[float]) -> float:
    return 1e3 * float(np.percentile(ages_s, 95))


async def measure(args: argparse.Namespace) -> dict[str, float]:
    source = open_source(args.source).without_truth()
    frames = list(source)
    bare = BareLoop(source.rig, args.threads)
    rounds: list[tuple[float, float, float]] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(args.source.partition(":")[2])
        archive = b"".join(Upload(folder).chunks_now())
        async with (
            serving(args.threads, f"{scratch}/jobs") as (grpc, http_address),
            httpx.AsyncClient(base_url=f"http://{http_address}", timeout=120) as http,
        ):
            for _ in range(args.rounds):
                batch = await batch_fps(http, archive, len(frames))
                rounds.append((bare.fps(source), bare.fps(frames), batch))
            alone = await live_ages_s(grpc, source.rig, frames, args.live_s)
            beside = [await submit(http, archive) for _ in range(args.beside)]
            together = await live_ages_s(grpc, source.rig, frames, args.live_s)
            jobs = [(await http.get(f"/v1/sequences/{job_id}")).json() for job_id in beside]
    bare_fps, memory_fps, fps = (median(column) for column in zip(*rounds, strict=True))
    half = len(together) // 2
    stepped = sum(job["frames_done"] for job in jobs)
    assert jobs[-1]["state"] != "done", "the batch was over before the live stream: raise --beside"
    return {
        "batch_fps": fps,
        "bare_fps": bare_fps,
        "ratio": fps / bare_fps,
        "memory_fps": memory_fps,
        "memory_ratio": fps / memory_fps,
        "live_age_p95_ms": p95_ms(together),
        "live_age_alone_p95_ms": p95_ms(alone),
        "live_age_first_half_p95_ms": p95_ms(together[:half]),
        "live_age_second_half_p95_ms": p95_ms(together[half:]),
        "live_frames": len(together),
        "live_frames_alone": len(alone),
        "live_batch_fps": stepped / args.live_s,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--source", default=bundled_sample(), help="vergence:PATH, rectified")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--live-s", type=float, default=8.0, help="of each live stream")
    parser.add_argument("--beside", type=int, default=10, help="sequences beside the live stream")
    parser.add_argument("--threads", type=int, default=2, help="of the model, here and there")
    figures = asyncio.run(measure(args := parser.parse_args()))
    print(f"isa {instruction_set()}")  # noqa: T201
    for name, value in figures.items():
        print(f"{name:30} {value:8.2f}")  # noqa: T201
    if args.json:
        args.json.write_text(json.dumps({"isa": instruction_set(), **figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()
