"""Measure jobs at the size that laboratories have: a long one, many small ones, a long queue.

    python tests/benchmarks/batch_scale.py --json FILE
    python tests/benchmarks/batch_scale.py --frames 300 --rows 100    # a check, of a minute

The bundled sequence, walked to and fro, is made as long as ``--frames`` says. The server is a real
process, and the bare loop runs in this one before and after the job.

- ``ratio_bare``: frames per second of one job, to those of a loop that reads and steps the frames.
- ``busy_share``: CPU time of the server while one job runs, to the time of all cores.
- ``two_jobs_ratio``: frames per second of two jobs in the queue, to those of one.
- ``small_jobs_per_s``: jobs of eight frames that are done in a second, of 40 sent at once.
- ``healthz_p99_ms``: time of /healthz while pages of a queue of ``--rows`` jobs are read.
- ``bytes_per_frame``: of the result of the long job on disk.
- ``server_rss_mib``: memory of the server after all of that, and ``server_rss_begin_mib`` when its
  model was loaded.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.benchmarks.batch_throughput import BareLoop
from tests.support.tokens import TokenFile
from vergence.cli.demo import bundled_sample
from vergence.jobs.packing import Upload
from vergence_proto.codec.images import decode_image
from vergence_proto.datasets import open_source
from vergence_proto.instruction_set import instruction_set

SMALL_JOBS, SMALL_FRAMES = 40, 8
TAR = {"Content-Type": "application/x-tar"}
POLL_S = 0.1  # clients that ask more often take the time of the job
LIST_S = 10.0
AT_ONCE = 4
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True, eq=False)
class Server:
    process: asyncio.subprocess.Process
    http: httpx.AsyncClient

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S

    def rss_mib(self) -> float:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) / 1024

    async def submit(self, archive: bytes) -> str:
        answer = await self.http.post("/v1/sequences", content=archive, headers=TAR)
        answer.raise_for_status()
        return str(answer.json()["id"])

    async def until(self, job_id: str, frames: float) -> dict[str, Any]:
        while True:
            job: dict[str, Any] = (await self.http.get(f"/v1/sequences/{job_id}")).json()
            if job["frames_done"] >= frames and (frames < job["frames"] or job["state"] == "done"):
                return job
            assert job["state"] in ("queued", "running"), job
            await asyncio.sleep(POLL_S)

    async def fps(self, *job_ids: str, frames: int) -> tuple[float, float]:
        """Frames per second, and the share of all cores, from a frame on to the end of all."""
        first = await self.until(job_ids[0], frames // 20)
        began_s, cpu_s = time.perf_counter(), self.cpu_s()
        for job_id in job_ids:
            await self.until(job_id, frames)
        seconds = time.perf_counter() - began_s
        rest = frames * len(job_ids) - first["frames_done"]
        return rest / seconds, (self.cpu_s() - cpu_s) / seconds / (os.cpu_count() or 1)


@asynccontextmanager
async def serving(folder: Path, engine: str) -> AsyncIterator[Server]:
    tokens = TokenFile(folder / "tokens.toml", "ana")
    settings = {
        "BATCH__DIRECTORY": str(folder / "jobs"),
        "BATCH__WAITING": "100000",
        "LIMITS__WAITING_SEQUENCES": "100000",
        "SECURITY__TOKENS": str(tokens.path),
        "MODEL__ENGINE": engine,
    }
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service", "--grpc-port", "0", "--http-port", "0"),
        env={**os.environ, **{f"VERGENCE_{key}": value for key, value in settings.items()}},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None
    try:
        _, _, address, *_ = (await process.stdout.readline()).decode().split()
        async with httpx.AsyncClient(
            base_url=f"http://{address.removeprefix('http=')}",
            headers=tokens.shown("ana"),
            timeout=300,
        ) as http:
            while b"ready" not in await process.stdout.readline():
                pass
            yield Server(process, http)
    finally:
        process.terminate()
        await process.wait()


def write_walk(folder: Path, frames: int, width: int) -> Path:
    """Write the bundled sequence, walked to and fro, as JPEG of this width."""
    folder.mkdir()
    source = open_source(bundled_sample())
    rig = source.rig.as_rectified()
    assert rig is not None
    scale = width / rig.width
    pictures: list[tuple[bytes, bytes, str]] = []
    for each in source.without_truth():
        pair = []
        for image in (each.frame.left, each.frame.right):
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
            pair.append(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())
        assert each.frame.pose is not None
        numbers = each.frame.pose.world_from_left.matrix[:3].ravel().tolist()
        pictures.append((pair[0], pair[1], " ".join(map(repr, numbers))))
    there_and_back = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    poses = []
    for index in range(frames):
        left, right, pose = pictures[there_and_back[index % len(there_and_back)]]
        (folder / f"frame_{index:05d}_left.jpg").write_bytes(left)
        (folder / f"frame_{index:05d}_right.jpg").write_bytes(right)
        poses.append(pose)
    (folder / "poses.txt").write_text("\n".join(poses))
    height, width = decode_image(pictures[0][0]).shape[:2]
    calibration = {
        "width": width,
        "height": height,
        "fx": rig.fx * scale,
        "fy": rig.fy * scale,
        "cx": (rig.cx_left + 0.5) * scale - 0.5,
        "cy": (rig.cy + 0.5) * scale - 0.5,
        "baseline_m": rig.baseline_m,
        "fps": 30.0,
    }
    (folder / "calib.json").write_text(json.dumps(calibration))
    return folder


def say(what: str) -> None:
    print(time.strftime("%H:%M:%S"), what, file=sys.stderr, flush=True)  # noqa: T201  progress


def packed(folder: Path) -> bytes:
    return b"".join(Upload(folder).chunks_now())


async def small_jobs_per_s(server: Server, archive: bytes) -> float:
    began_s = time.perf_counter()
    job_ids = await asyncio.gather(*(server.submit(archive) for _ in range(SMALL_JOBS)))
    for job_id in job_ids:
        await server.until(job_id, SMALL_FRAMES)
    return SMALL_JOBS / (time.perf_counter() - began_s)


async def healthz_p99_ms(server: Server, archive: bytes, rows: int) -> tuple[float, float]:
    """Time of /healthz, and of a page, while another client reads pages of a long queue."""
    for begin in range(0, rows, AT_ONCE):
        count = min(AT_ONCE, rows - begin)
        await asyncio.gather(*(server.submit(archive) for _ in range(count)))
    over = time.perf_counter() + LIST_S
    health_ms: list[float] = []
    pages_ms: list[float] = []

    async def ask(path: str, times_ms: list[float], pause_s: float) -> None:
        while (began_s := time.perf_counter()) < over:
            (await server.http.get(path)).raise_for_status()
            times_ms.append(1e3 * (time.perf_counter() - began_s))
            await asyncio.sleep(pause_s)

    await asyncio.gather(
        ask("/healthz", health_ms, 0.005), ask("/v1/sequences?page_size=100", pages_ms, 0.0)
    )
    return float(np.percentile(health_ms, 99)), float(np.median(pages_ms))


async def measure(args: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="batch-scale-") as scratch:
        folder = Path(scratch)
        long = write_walk(folder / "long", args.frames, args.width)
        half = packed(write_walk(folder / "half", args.frames // 2, args.width))
        small = packed(write_walk(folder / "small", SMALL_FRAMES, args.width))
        source = open_source(f"vergence:{long}")
        bare = BareLoop(source.rig, 0)
        say("bare loop")
        before_fps = bare.fps(source)
        async with serving(folder, args.engine) as server:
            figures: dict[str, Any] = {"server_rss_begin_mib": server.rss_mib()}
            say("one job")
            job_id = await server.submit(packed(long))
            fps, busy = await server.fps(job_id, frames=args.frames)
            job = await server.until(job_id, args.frames)
            figures["server_rss_after_job_mib"] = server.rss_mib()
            say("two jobs")
            two = [await server.submit(half) for _ in range(2)]
            two_fps, two_busy = await server.fps(*two, frames=args.frames // 2)
            say(f"{SMALL_JOBS} small jobs")
            figures["small_jobs_per_s"] = await small_jobs_per_s(server, small)
            say(f"{args.rows} jobs in the queue")
            health_ms, page_ms = await healthz_p99_ms(server, small, args.rows)
            figures["server_rss_mib"] = server.rss_mib()
        say("bare loop again")
        after_fps = bare.fps(source)
    return {
        "frames": args.frames,
        "engine": args.engine,
        "bare_fps": (before_fps + after_fps) / 2,
        "job_fps": fps,
        "ratio_bare": 2 * fps / (before_fps + after_fps),
        "busy_share": busy,
        "two_jobs_fps": two_fps,
        "two_jobs_busy_share": two_busy,
        "two_jobs_ratio": two_fps / fps,
        "healthz_p99_ms": health_ms,
        "page_median_ms": page_ms,
        "bytes_per_frame": job["result_bytes"] / args.frames,
        **figures,
        "instruction_set": instruction_set(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--width", type=int, default=320, help="of the images, in pixels")
    parser.add_argument("--rows", type=int, default=1000, help="jobs in the long queue")
    parser.add_argument("--engine", default="auto", help="auto, native or onnxruntime")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    figures = asyncio.run(measure(args))
    for name, value in figures.items():
        shown = f"{value:.3f}" if isinstance(value, float) else value
        print(f"{name:26} {shown}")  # noqa: T201  the result
    if args.json is not None:
        args.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
