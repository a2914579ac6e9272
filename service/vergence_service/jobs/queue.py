"""The queue of sequences: what is taken, how far it is, and what came of it."""

import asyncio
import secrets
import time
from collections.abc import AsyncIterator
from contextlib import AbstractContextManager, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vergence_proto.datasets import StereoSource
from vergence_proto.errors import (
    QueueFull,
    Quota,
    SequenceNotDone,
)
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.results import result_bytes
from vergence_service.jobs.run import job_stream_config
from vergence_service.jobs.sources import find_sequence, open_below
from vergence_service.jobs.store import JobStore, folder_bytes, remove_folder
from vergence_service.jobs.upload_checks import check_folder
from vergence_service.jobs.worker import JobWorker
from vergence_service.streams.engine import DepthEngine


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueLimits:
    waiting: int  # jobs, the running ones included
    waiting_per_client: int | None
    checkpoint_s: float  # of work that a crash may cost
    keep_s: float  # what has ended
    disk_bytes: int  # of all jobs together


@dataclass(frozen=True, slots=True)
class JobStatus:
    """A job and how far it is."""

    job: Job
    frames_done: int
    ahead: int  # jobs that run before it
    fps: float | None
    eta_s: float | None  # of its own frames


class JobQueue:
    """What clients ask of their jobs: to take them, to tell of them, to give what came of them.

    Use it inside ``async with``; jobs run from :meth:`start` on. All of its methods belong to the
    event loop; files and the database are touched in threads.
    """

    def __init__(self, engine: DepthEngine, store: JobStore, *, limits: QueueLimits) -> None:
        self._engine = engine
        self._store = store
        self._limits = limits
        self._registry = JobRegistry(store, keep_s=limits.keep_s, disk_bytes=limits.disk_bytes)
        self._worker = JobWorker(engine, self._registry, checkpoint_s=limits.checkpoint_s)
        self._uploads: list[str] = []  # whose they are

    async def __aenter__(self) -> Self:
        await self._registry.load()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._worker.stop()

    def start(self) -> None:
        """Run what waits, that of earlier servers first."""
        self._worker.start()

    @asynccontextmanager
    async def reserve_slot(self, client: str) -> AsyncIterator[Path]:
        """A place in the queue, and a folder to receive an upload in, removed if not accepted.

        ``client`` is the address that it comes from. Raises QueueFull, Quota.
        """
        self._check_room(client)
        self._uploads.append(client)
        try:
            folder = await asyncio.to_thread(self._store.new_folder)
            try:
                yield folder
            finally:
                await asyncio.to_thread(remove_folder, folder)
        finally:
            self._uploads.remove(client)

    def _check_room(self, client: str) -> None:
        limits = self._limits
        waiting = [*(job.client for job in self._registry.unfinished()), *self._uploads]
        if len(waiting) >= limits.waiting:
            raise QueueFull(
                f"{limits.waiting} sequences are waiting, as many as may; try again later",
                retry_after_s=self._worker.usual_job_s(),
            )
        theirs = waiting.count(client)
        if limits.waiting_per_client is not None and theirs >= limits.waiting_per_client:
            raise Quota(
                f"{theirs} sequences of {client} are waiting, as many as of one client may; try "
                "again later",
                retry_after_s=self._worker.usual_job_s(),
            )

    async def accept(
        self, folder: Path, wanted: str | None, options: JobOptions, *, client: str
    ) -> JobStatus:
        """Take the sequence below ``folder``/input; from the return on it will not be lost.

        ``wanted`` is KIND:PATH, and needed where there are several. Raises BadSequence, QueueFull,
        UploadTooLarge, FrameTooLarge, and what DepthEngine.open_offline raises.
        """
        limit = self._engine.max_pixels
        spec, source = await asyncio.to_thread(_find, folder / "input", wanted, max_pixels=limit)
        await self._engine.open_offline(job_stream_config(source, options))  # for its refusals
        uploaded = await asyncio.to_thread(folder_bytes, folder)
        job = Job(
            job_id=secrets.token_hex(8),
            source=spec,
            frames=len(source),
            source_fps=source.fps,
            created_s=time.time(),
            client=client,
            options=options,
            disk_bytes=uploaded + result_bytes(source, options.outputs),
        )
        await self._registry.make_room(job.disk_bytes, retry_after_s=self._worker.usual_job_s())
        await self._registry.accept(folder, job)
        return self.status(job.job_id)

    def status(self, job_id: str) -> JobStatus:
        """Raises UnknownSequence."""
        job = self._registry.get(job_id)
        progress = self._worker.progress(job_id)
        if job.ended or progress is None:
            done = job.frames if job.state is JobState.DONE else 0
            ahead = 0 if job.ended else self._registry.unfinished().index(job)
            return JobStatus(job, done, ahead, job.fps, None)
        return JobStatus(
            job, progress.frames_done, 0, progress.fps or None, progress.eta_s(job.frames)
        )

    def statuses(self) -> list[JobStatus]:
        """Of all jobs, oldest first."""
        return [self.status(job.job_id) for job in self._registry]

    async def change(self, *, within_s: float) -> None:
        """Wait until a job begins, ends or is deleted, but not for longer than ``within_s``."""
        await self._registry.change(within_s=within_s)

    async def delete(self, job_id: str) -> None:
        """Stop the job if it has not ended, and remove all that it has. Raises UnknownSequence."""
        self._registry.forget(job_id)
        await self._worker.cancel(job_id)
        await self._registry.remove(job_id)

    def result(self, job_id: str) -> tuple[Job, Path]:
        """A job that is done, and the folder of its result.

        Raises UnknownSequence, SequenceNotDone.
        """
        job = self._registry.get(job_id)
        if job.state is not JobState.DONE:
            failure = f": {job.reason}: {job.message}" if job.state is JobState.FAILED else ""
            raise SequenceNotDone(
                f"sequence {job_id} has no result, it is {job.state}{failure}",
                retry_after_s=None if job.ended else self._worker.usual_job_s(),
            )
        return job, self._registry.folder(job_id) / "result"

    def reading(self, job_id: str) -> AbstractContextManager[None]:
        """The job's result does not expire before the block ends."""
        return self._registry.reading(job_id)


def _find(folder: Path, wanted: str | None, *, max_pixels: int) -> tuple[str, StereoSource]:
    check_folder(folder, max_pixels=max_pixels)
    spec = find_sequence(folder, wanted)
    return spec, open_below(folder, spec)
