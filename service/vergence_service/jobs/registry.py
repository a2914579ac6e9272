"""All jobs of a server as they stand, kept on disk within their limits of age and room."""

import asyncio
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vergence_proto.errors import QueueFull, UnknownSequence, UploadTooLarge
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job
from vergence_service.jobs.store import JobStore, folder_bytes


class JobRegistry:
    """The jobs of a store in memory, oldest first, and word of their changes.

    All methods belong to the event loop; files and the database are touched in threads.
    """

    def __init__(self, store: JobStore, *, keep_s: float, disk_bytes: int) -> None:
        self._store = store
        self._keep_s = keep_s
        self._disk_bytes = disk_bytes
        self._jobs: dict[str, Job] = {}
        self._readers: Counter[str] = Counter()
        self._changed = asyncio.Condition()

    async def load(self) -> None:
        jobs = await asyncio.to_thread(self._store.load)
        self._jobs = {job.job_id: job for job in jobs}

    def __contains__(self, job_id: str) -> bool:
        return job_id in self._jobs

    def __iter__(self) -> Iterator[Job]:
        return iter(list(self._jobs.values()))

    def get(self, job_id: str) -> Job:
        """Raises UnknownSequence."""
        if job_id not in self._jobs:
            raise UnknownSequence(
                f"no sequence {job_id[:64]!r}: it never was, was deleted, or its result expired, "
                f"{self._keep_s / 3600:g} h after its end or when disk space ran short"
            )
        return self._jobs[job_id]

    def unfinished(self) -> list[Job]:
        return [job for job in self._jobs.values() if not job.ended]

    def count(self, state: JobState) -> int:
        return sum(job.state is state for job in self._jobs.values())

    def folder(self, job_id: str) -> Path:
        return self._store.folder(job_id)

    async def change(self, *, within_s: float) -> None:
        """Wait until a job begins, ends or is removed, but not for longer than ``within_s``."""
        async with self._changed:
            try:
                await asyncio.wait_for(self._changed.wait(), within_s)
            except TimeoutError:
                return

    async def accept(self, folder: Path, job: Job) -> None:
        """From the return on the job will not be lost."""
        await asyncio.to_thread(self._store.accept, folder, job)
        self._jobs[job.job_id] = job
        await self._tell()

    async def update(self, job: Job) -> None:
        await asyncio.to_thread(self._store.update, job)
        if job.job_id in self._jobs:
            self._jobs[job.job_id] = job
            await self._tell()

    async def finish(self, job: Job) -> None:
        """The job has ended."""
        result = self._store.folder(job.job_id) / "result"
        done = job.state is JobState.DONE
        taken = await asyncio.to_thread(folder_bytes, result) if done else 0
        job = replace(job, finished_s=time.time(), disk_bytes=taken)
        await self.update(job)
        # Only now: a server that is killed before the row says so needs the input again.
        await asyncio.to_thread(self._store.tidy, job)

    def forget(self, job_id: str) -> None:
        """Nobody hears of the job any more; :meth:`remove` follows. Raises UnknownSequence."""
        self.get(job_id)
        del self._jobs[job_id]

    async def remove(self, job_id: str) -> None:
        """Row, files and all."""
        self._jobs.pop(job_id, None)
        await asyncio.to_thread(self._store.delete, job_id)
        await self._tell()

    @contextmanager
    def reading(self, job_id: str) -> Iterator[None]:
        """The job's result does not expire before the block ends."""
        self._readers[job_id] += 1
        try:
            yield
        finally:
            self._readers[job_id] -= 1

    def taken_bytes(self) -> int:
        """What all jobs take on disk, or may until they end."""
        return sum(job.disk_bytes for job in self._jobs.values())

    async def expire(self) -> None:
        """Remove what ended too long ago."""
        before_s = time.time() - self._keep_s
        for job in self._removable():
            if (job.finished_s or 0) < before_s:
                await self.remove(job.job_id)

    async def make_room(self, needed_bytes: int, *, retry_after_s: float) -> None:
        """Let the oldest results go until a new job fits. Raises QueueFull, UploadTooLarge."""
        if needed_bytes > self._disk_bytes:
            raise UploadTooLarge(
                f"the sequence and its result take {needed_bytes} bytes, the server keeps "
                f"{self._disk_bytes} for all; send it in parts"
            )
        for job in sorted(self._removable(), key=lambda job: job.finished_s or 0):
            if self.taken_bytes() + needed_bytes <= self._disk_bytes:
                return
            await self.remove(job.job_id)
        if self.taken_bytes() + needed_bytes > self._disk_bytes:
            raise QueueFull(
                f"the sequences that wait take {self.taken_bytes()} of {self._disk_bytes} bytes "
                f"on disk, this one needs {needed_bytes}; try again later",
                retry_after_s=retry_after_s,
            )

    def _removable(self) -> list[Job]:
        return [job for job in self if job.ended and self._readers[job.job_id] == 0]

    async def _tell(self) -> None:
        async with self._changed:
            self._changed.notify_all()
