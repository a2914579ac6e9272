"""All jobs of a server in memory: their state, progress and results, within age and disk limits."""

import asyncio
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vergence_proto.errors import QueueFull, SequenceNotDone, UnknownSequence, UploadTooLarge
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobProgress, JobStatus
from vergence_service.jobs.store import JobStore, folder_bytes
from vergence_service.threads import ThreadPool, to_the_end

# The expected duration of a job before any has run. Clients are asked to retry after it.
_USUAL_JOB_S = 2.0


class JobRegistry:
    """The jobs of a store, oldest first.

    Routes read it, the queue adds to it, and the worker changes it. All methods belong to the event
    loop; threads touch the files and the database.
    """

    def __init__(
        self, store: JobStore, *, keep_s: float, disk_bytes: int, background: ThreadPool
    ) -> None:
        self._store = store
        self._background = background
        self._keep_s = keep_s
        self._disk_bytes = disk_bytes
        self._jobs: dict[str, Job] = {}
        self._running: dict[str, JobProgress] = {}
        self._readers: Counter[str] = Counter()
        self._changed = asyncio.Condition()
        self._last_job_s = _USUAL_JOB_S

    async def load(self) -> None:
        """Read the jobs of earlier servers."""
        jobs = await self._background.run(self._store.load)
        self._jobs = {job.job_id: job for job in jobs}

    # Reading.

    def get(self, job_id: str) -> Job:
        """Return a job. Raises UnknownSequence."""
        if job_id not in self._jobs:
            raise UnknownSequence(
                f"no sequence {job_id[:64]!r}: it never existed, was deleted, or its result "
                f"expired, {self._keep_s / 3600:g} h after its end or when disk space ran short"
            )
        return self._jobs[job_id]

    def unfinished(self) -> list[Job]:
        """Return the jobs that wait or run, oldest first."""
        return [job for job in self._jobs.values() if not job.ended]

    def count(self, state: JobState) -> int:
        """Count the jobs in a state."""
        return sum(job.state is state for job in self._jobs.values())

    def status(self, job_id: str) -> JobStatus:
        """Return a job with its progress. Raises UnknownSequence."""
        job = self.get(job_id)
        progress = self._running.get(job_id)
        if job.ended or progress is None:
            done = job.frames if job.state is JobState.DONE else 0
            ahead = 0 if job.ended else self.unfinished().index(job)
            return JobStatus(job, done, ahead, job.fps, None)
        return JobStatus(
            job, progress.frames_done, 0, progress.fps or None, progress.eta_s(job.frames)
        )

    def statuses(self) -> list[JobStatus]:
        """Return all jobs with their progress, oldest first."""
        return [self.status(job_id) for job_id in self._jobs]

    def result(self, job_id: str) -> tuple[Job, Path]:
        """Return a job that is done, and the folder of its result.

        Raises UnknownSequence, and SequenceNotDone if the job waits, runs or has failed.
        """
        job = self.get(job_id)
        if job.state is not JobState.DONE:
            failure = f": {job.reason}: {job.message}" if job.state is JobState.FAILED else ""
            raise SequenceNotDone(
                f"sequence {job_id} has no result, it is {job.state}{failure}",
                retry_after_s=None if job.ended else self.usual_job_s(),
            )
        return job, self.folder(job_id) / "result"

    @contextmanager
    def reading(self, job_id: str) -> Iterator[None]:
        """Keep the job's result from expiring until the block ends."""
        self._readers[job_id] += 1
        try:
            yield
        finally:
            self._readers[job_id] -= 1

    async def change(self, *, within_s: float) -> None:
        """Wait until a job begins, ends or is deleted, but at most ``within_s``."""
        async with self._changed:
            try:
                await asyncio.wait_for(self._changed.wait(), within_s)
            except TimeoutError:
                return

    def usual_job_s(self) -> float:
        """Estimate the time until the queue has a free place."""
        etas_s = [
            progress.eta_s(self._jobs[job_id].frames)
            for job_id, progress in self._running.items()
            if job_id in self._jobs
        ]
        return max((eta_s for eta_s in etas_s if eta_s is not None), default=self._last_job_s)

    def folder(self, job_id: str) -> Path:
        """Return the folder with the files of a job."""
        return self._store.folder(job_id)

    # Changing.

    async def add(self, folder: Path, job: Job) -> None:
        """Add a job with its uploaded files. When this returns, a crash does not lose the job."""
        await to_the_end(self._add(folder, job))

    async def _add(self, folder: Path, job: Job) -> None:
        await self._background.run(self._store.insert, folder, job)
        self._jobs[job.job_id] = job
        await self._notify_changed()

    def begin_run(self, job_id: str) -> JobProgress:
        """Record that the worker runs a job; return the progress of the run, for it to update."""
        progress = self._running[job_id] = JobProgress()
        return progress

    def end_stepping(self, job_id: str) -> None:
        """Record that the model is free again."""
        self._last_job_s = self._running[job_id].elapsed_s

    def end_run(self, job_id: str) -> None:
        """Record that the worker does nothing more for a job."""
        del self._running[job_id]

    async def update(self, job: Job) -> None:
        """Replace the entry of a job, unless it was deleted."""
        await self._background.run(self._store.update, job)
        if job.job_id in self._jobs:
            self._jobs[job.job_id] = job
            await self._notify_changed()

    async def finish(self, job: Job) -> None:
        """Record that a job has ended, and remove the files that it needs no more."""
        result = self._store.folder(job.job_id) / "result"
        done = job.state is JobState.DONE
        used = await self._background.run(folder_bytes, result) if done else 0
        job = replace(job, finished_s=time.time(), disk_bytes=used)
        await self.update(job)
        # Only now: a server that is killed before the row is written needs the input again.
        await self._background.run(self._store.tidy, job)

    def hide(self, job_id: str) -> None:
        """Make a job unknown to readers at once; :meth:`delete` follows. Raises UnknownSequence."""
        self.get(job_id)
        del self._jobs[job_id]

    async def delete(self, job_id: str) -> None:
        """Delete a job with its row and its files."""
        self._jobs.pop(job_id, None)
        await self._background.run(self._store.delete, job_id)
        await self._notify_changed()

    # Limits of age and disk space.

    def used_bytes(self) -> int:
        """Return the disk space that all jobs use or have reserved."""
        return sum(job.disk_bytes for job in self._jobs.values())

    async def expire(self) -> None:
        """Delete the jobs that ended too long ago."""
        before_s = time.time() - self._keep_s
        for job in self._removable():
            if (job.finished_s or 0) < before_s:
                await self.delete(job.job_id)

    async def make_room(self, needed_bytes: int) -> None:
        """Delete the oldest results until a new job fits.

        Raises UploadTooLarge if the job can never fit, and QueueFull if it does not fit now.
        """
        if needed_bytes > self._disk_bytes:
            raise UploadTooLarge(
                f"the sequence and its result need {needed_bytes} bytes, the server keeps "
                f"{self._disk_bytes} for all sequences; send it in parts, or start the server with "
                "a larger batch.disk_mib"
            )
        for job in sorted(self._removable(), key=lambda job: job.finished_s or 0):
            if self.used_bytes() + needed_bytes <= self._disk_bytes:
                return
            await self.delete(job.job_id)
        if self.used_bytes() + needed_bytes > self._disk_bytes:
            raise QueueFull(
                f"the waiting sequences use {self.used_bytes()} of {self._disk_bytes} bytes on "
                f"disk, this one needs {needed_bytes}; try again later (the server's setting "
                "batch.disk_mib)",
                retry_after_s=self.usual_job_s(),
            )

    def _removable(self) -> list[Job]:
        return [job for job in self._jobs.values() if job.ended and not self._readers[job.job_id]]

    async def _notify_changed(self) -> None:
        async with self._changed:
            self._changed.notify_all()
