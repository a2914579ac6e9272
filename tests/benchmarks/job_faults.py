"""A long job under faults: kill -9 again and again, and a disk that is full for a while.

    python tests/benchmarks/job_faults.py --kills 20 --full-s 10 --json FILE

The same sequence is stepped three times by real server processes: undisturbed, by servers that are
killed as soon as the job has progressed a little, and on a disk that is full for a while (a small
file system in memory where root allows, otherwise a limit on the length of files). The benchmark
passes (exit code 0) if both disturbed jobs are done and their results equal the undisturbed one.
"""

import argparse
import asyncio
import contextlib
import hashlib
import io
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.frames import make_frame
from tests.support.full_disk import filled
from tests.support.http import ZIP
from tests.support.sequences import sequence_files, zip_bytes
from vergence_proto.instruction_set import instruction_set

REPOSITORY = Path(__file__).parents[2]
DISK_MIB = 96
PATIENCE_S = 600.0
SHORT_FILES = 4096  # bytes, where no small disk can be mounted


@dataclass(frozen=True, slots=True, eq=False)
class Server:
    process: asyncio.subprocess.Process
    http: httpx.AsyncClient

    async def submit(self, archive: bytes) -> str:
        answer = await self.http.post("/v1/sequences", content=archive, headers=ZIP)
        assert answer.status_code == httpx.codes.ACCEPTED, answer.text
        return str(answer.json()["id"])

    async def job(self, job_id: str) -> dict[str, Any]:
        job: dict[str, Any] = (await self.http.get(f"/v1/sequences/{job_id}")).json()
        return job

    async def until(self, job_id: str, frames_done: float) -> dict[str, Any]:
        """Wait until so many frames are done, or the job has ended; return the job."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                job = await self.job(job_id)
                if job["state"] in ("done", "failed") or job["frames_done"] >= frames_done:
                    return job
                await asyncio.sleep(0.02)

    async def digest(self, job_id: str) -> str:
        """A hash of the result, apart from the manifest, which states when the job ran."""
        answer = await self.http.get(f"/v1/sequences/{job_id}/result", params={"format": "npz"})
        if answer.status_code != httpx.codes.OK:
            return answer.text
        with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
            names = sorted({*file.namelist()} - {"manifest.json"})
            return hashlib.sha256(b"".join(map(file.read, names))).hexdigest()


@contextlib.asynccontextmanager
async def server_on(folder: Path) -> AsyncIterator[Server]:
    """A server whose jobs are in ``folder``. It is killed at the end."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service", "--grpc-port", "0", "--http-port", "0"),
        cwd=REPOSITORY,
        env={
            **os.environ,
            "VERGENCE_BATCH__DIRECTORY": str(folder),
            "VERGENCE_BATCH__CHECKPOINT_S": "0.5",
            "VERGENCE_MODEL__THREADS": "1",
        },
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        assert process.stdout is not None
        found = re.search(r"http=(\S+)", (await process.stdout.readline()).decode())
        assert found, "the server did not start"
        async with httpx.AsyncClient(base_url=f"http://{found[1]}", timeout=60) as http:
            yield Server(process, http)
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGKILL)
        await process.wait()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """Mount a small file system at ``folder``, if this process may; yield whether it did."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextlib.contextmanager
def short_files(process_id: int) -> Iterator[None]:
    before = resource.prlimit(process_id, resource.RLIMIT_FSIZE)
    resource.prlimit(process_id, resource.RLIMIT_FSIZE, (SHORT_FILES, before[1]))
    try:
        yield
    finally:
        resource.prlimit(process_id, resource.RLIMIT_FSIZE, before)


async def undisturbed(folder: Path, archive: bytes) -> dict[str, Any]:
    async with server_on(folder) as server:
        began_s = time.monotonic()
        job_id = await server.submit(archive)
        job = await server.until(job_id, float("inf"))
        seconds = time.monotonic() - began_s
        return {"frames": job["frames"], "seconds": seconds, "digest": await server.digest(job_id)}


async def killed(folder: Path, archive: bytes, kills: int) -> dict[str, Any]:
    began_s = time.monotonic()
    async with server_on(folder) as server:
        job_id = await server.submit(archive)
        frames = (await server.job(job_id))["frames"]
        step = frames / (kills + 1)
        reached = [(await server.until(job_id, step))["frames_done"]]
    for number in range(2, kills + 1):
        async with server_on(folder) as server:
            progressed = max(number * step, reached[-1] + 1)
            reached.append((await server.until(job_id, progressed))["frames_done"])
    async with server_on(folder) as server:
        job = await server.until(job_id, float("inf"))
        return {
            "killed_at": reached,
            "state": job["state"],
            "message": job["message"],
            "seconds": time.monotonic() - began_s,
            "digest": await server.digest(job_id),
        }


async def disk_full(folder: Path, archive: bytes, full_s: float) -> dict[str, Any]:
    with small_disk(folder) as mounted:
        async with server_on(folder) as server:
            job_id = await server.submit(archive)
            await server.until(job_id, (await server.job(job_id))["frames"] / 3)
            fault = filled(folder) if mounted else short_files(server.process.pid)
            with fault:
                await asyncio.sleep(full_s)
                then = await server.job(job_id)
            job = await server.until(job_id, float("inf"))
            return {
                "means": "a full file system" if mounted else "a limit on the length of files",
                "while_full": [then["state"], then["frames_done"], then["reason"]],
                "state": job["state"],
                "message": job["message"],
                "digest": await server.digest(job_id),
            }


async def measure(kills: int, full_s: float, frames: int) -> dict[str, Any]:
    scene = (make_frame(index, brightness=40 + index % 200) for index in range(1, frames + 1))
    archive = zip_bytes(sequence_files(scene))
    with tempfile.TemporaryDirectory() as scratch:
        whole = await undisturbed(Path(scratch) / "whole", archive)
        shot = await killed(Path(scratch) / "killed", archive, kills)
        full = await disk_full(Path(scratch) / "full", archive, full_s)
    for disturbed in (shot, full):
        disturbed["equal"] = disturbed.pop("digest") == whole["digest"]
    return {"undisturbed": whole, "kills": kills, "killed": shot, "full_s": full_s, "full": full}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--full-s", type=float, default=10.0)
    parser.add_argument("--frames", type=int, default=800)
    parser.add_argument("--json", type=Path, help="write the figures there")
    args = parser.parse_args()
    figures = asyncio.run(measure(args.kills, args.full_s, args.frames))
    figures = {"isa": instruction_set(), **figures}
    for name, value in figures.items():
        print(f"{name:12} {value}")  # noqa: T201
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    disturbed = (figures["killed"], figures["full"])
    sys.exit(not all(each["state"] == "done" and each["equal"] for each in disturbed))


if __name__ == "__main__":
    main()
