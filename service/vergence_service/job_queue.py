"""Sequences that were accepted: run in order, kept for a while, and told about."""

import asyncio
import logging
import secrets
import time
from collections.abc import AsyncIterator
from contextlib import AbstractContextManager, asynccontextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

from vergence_proto.errors import (
    DepthError,
    Draining,
    ModelFailed,
    NotReady,
    QueueFull,
    Quota,
    SequenceNotDone,
)
from vergence_proto.layouts import StereoSource
from vergence_service.contents import check_folder
from vergence_service.engine import DepthEngine
from vergence_service.job_run import Progress, opening_of, run_job
from vergence_service.job_shelf import JobShelf
from vergence_service.jobs import (
    Job,
    JobOptions,
    JobState,
    JobStore,
    folder_bytes,
    remove_folder,
)
from vergence_service.results import result_bytes
from vergence_service.sequences import find_sequence, open_below

log = logging.getLogger(__name__)

# A sequence that was running so often when the server died is taken to be the cause.
_MAX_ATTEMPTS = 4
_EXPIRE_EVERY_S = 30.0
# Before trying again what the disk refused.
_TROUBLE_PAUSE_S = 5.0
# What a job is taken to need before one has run; clients are told to come back after it.
_USUAL_JOB_S = 2.0


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


@dataclass(slots=True, eq=False)
class _Running:
    progress: Progress = field(default_factory=Progress)
    task: asyncio.Task[None] | None = None
    stepped: asyncio.Event = field(default_factory=asyncio.Event)  # the model is free again


class JobQueue:
    """Steps one job at a time, so that a sequence is done as early as it can be.

    Use it inside ``async with``; jobs run from :meth:`start` on. All of its methods belong to the
    event loop; files and the database are touched in threads.
    """

    def __init__(self, engine: DepthEngine, store: JobStore, *, limits: QueueLimits) -> None:
        self._engine = engine
        self._store = store
        self._limits = limits
        self._shelf = JobShelf(store, keep_s=limits.keep_s, disk_bytes=limits.disk_bytes)
        self._running: dict[str, _Running] = {}  # at most one is stepped, one is being put away
        self._leaving = False  # the server is shutting down
        self._last_job_s = _USUAL_JOB_S
        self._uploads: list[str] = []  # whose they are
        self._tasks: list[asyncio.Task[None]] = []
        self._metrics = engine.metrics
        self._metrics.sequence_disk_bytes.set_function(self._shelf.taken_bytes)
        for state in (JobState.QUEUED, JobState.RUNNING):
            self._metrics.sequences.labels(state).set_function(partial(self._count, state))

    async def __aenter__(self) -> Self:
        await self._shelf.load()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def start(self) -> None:
        """Run what waits, that of earlier servers first."""
        self._tasks = [
            asyncio.create_task(self._run_all(), name="sequences"),
            asyncio.create_task(self._expire_now_and_then(), name="expire results"),
        ]

    @asynccontextmanager
    async def place(self, client: str) -> AsyncIterator[Path]:
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
        waiting = [*(job.client for job in self._shelf.unfinished()), *self._uploads]
        if len(waiting) >= limits.waiting:
            raise QueueFull(
                f"{limits.waiting} sequences are waiting, as many as may; try again later",
                retry_after_s=self._usual_job_s(),
            )
        theirs = waiting.count(client)
        if limits.waiting_per_client is not None and theirs >= limits.waiting_per_client:
            raise Quota(
                f"{theirs} sequences of {client} are waiting, as many as of one client may; try "
                "again later",
                retry_after_s=self._usual_job_s(),
            )

    async def accept(
        self, folder: Path, wanted: str | None, options: JobOptions, *, client: str
    ) -> JobStatus:
        """Take the sequence below ``folder``/input; from the return on it will not be lost.

        ``wanted`` is KIND:PATH, and needed where there are several. Raises BadSequence, QueueFull,
        UploadTooLarge, FrameTooLarge, and what DepthEngine.open_apart raises.
        """
        limit = self._engine.max_pixels
        spec, source = await asyncio.to_thread(_find, folder / "input", wanted, max_pixels=limit)
        await self._engine.open_apart(opening_of(source, options))  # for its refusals
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
        await self._shelf.make_room(job.disk_bytes, retry_after_s=self._usual_job_s())
        await self._shelf.accept(folder, job)
        return self.status(job.job_id)

    def status(self, job_id: str) -> JobStatus:
        """Raises UnknownSequence."""
        job = self._shelf.get(job_id)
        running = self._running.get(job_id)
        if job.ended or running is None:
            done = job.frames if job.state is JobState.DONE else 0
            ahead = 0 if job.ended else self._shelf.unfinished().index(job)
            return JobStatus(job, done, ahead, job.fps, None)
        done, fps = running.progress.frames_done, running.progress.fps
        return JobStatus(job, done, 0, fps or None, (job.frames - done) / fps if fps else None)

    def statuses(self) -> list[JobStatus]:
        """Of all jobs, oldest first."""
        return [self.status(job.job_id) for job in self._shelf]

    async def change(self, *, within_s: float) -> None:
        """Wait until a job begins, ends or is deleted, but not for longer than ``within_s``."""
        await self._shelf.change(within_s=within_s)

    async def delete(self, job_id: str) -> None:
        """Stop the job if it has not ended, and remove all that it has. Raises UnknownSequence."""
        self._shelf.forget(job_id)
        running = self._running.get(job_id)
        if running is not None and running.task is not None:
            running.task.cancel()
            await asyncio.gather(running.task, return_exceptions=True)
        await self._shelf.remove(job_id)

    def result(self, job_id: str) -> tuple[Job, Path]:
        """A job that is done, and the folder of its result.

        Raises UnknownSequence, SequenceNotDone.
        """
        job = self._shelf.get(job_id)
        if job.state is not JobState.DONE:
            failure = f": {job.reason}: {job.message}" if job.state is JobState.FAILED else ""
            raise SequenceNotDone(
                f"sequence {job_id} has no result, it is {job.state}{failure}",
                retry_after_s=None if job.ended else self._usual_job_s(),
            )
        return job, self._shelf.folder(job_id) / "result"

    def reading(self, job_id: str) -> AbstractContextManager[None]:
        """The job's result does not expire before the block ends."""
        return self._shelf.reading(job_id)

    async def _run_all(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            before: asyncio.Task[None] | None = None
            while not self._leaving:
                waiting = self._shelf.unfinished()
                job = next((each for each in waiting if each.job_id not in self._running), None)
                if job is None:
                    await self._shelf.change(within_s=_EXPIRE_EVERY_S)
                    continue
                running = self._running[job.job_id] = _Running()
                name = f"sequence {job.job_id}"
                running.task = tasks.create_task(self._run(job, running), name=name)
                # While one is put away the next is stepped, and no more: disks can be slow.
                await running.stepped.wait()
                if before is not None:
                    await asyncio.wait([before])
                before = running.task

    async def _run(self, job: Job, running: _Running) -> None:
        try:
            try:
                ended = await self._stepped(job, running)
            finally:
                self._last_job_s = time.monotonic() - running.progress.since_s
                running.stepped.set()
            # Before anybody can hear of the end in another way.
            self._count_ended(ended, running.progress)
            await self._shelf.put_away(ended)
        except (Draining, NotReady):
            self._leaving = True
        except Exception:  # a full disk, most likely: the job keeps its place
            log.exception("the state of sequence %s could not be kept", job.job_id)
            await asyncio.sleep(_TROUBLE_PAUSE_S)
        finally:
            del self._running[job.job_id]

    async def _stepped(self, job: Job, running: _Running) -> Job:
        """The job as it is after its frames were stepped, or one of them was not."""
        if job.attempts >= _MAX_ATTEMPTS:
            return _failed(
                job, ModelFailed(f"the server died {job.attempts} times while it ran this sequence")
            )
        started = replace(job, state=JobState.RUNNING, attempts=job.attempts + 1)
        await self._shelf.update(started)

        try:
            folder = self._shelf.folder(job.job_id)
            found = await run_job(
                self._engine,
                folder,
                started,
                running.progress,
                checkpoint_s=self._limits.checkpoint_s,
            )
        except (Draining, NotReady, asyncio.CancelledError):
            # Not the sequence's doing: it keeps its place, for this server or the next one.
            await self._shelf.update(replace(job, state=JobState.QUEUED))
            raise
        except DepthError as error:
            return _failed(started, error)
        except Exception:
            log.exception("sequence %s failed in a way that nobody foresaw", job.job_id)
            return _failed(started, ModelFailed("the server failed; its log says why"))
        accuracy = None if found is None else asdict(found)
        return replace(
            started, state=JobState.DONE, fps=running.progress.fps or None, accuracy=accuracy
        )

    def _count(self, state: JobState) -> int:
        return sum(job.state is state for job in self._shelf)

    def _count_ended(self, job: Job, progress: Progress) -> None:
        if job.state is JobState.DONE:
            self._metrics.sequences_done.inc()
            self._metrics.sequence_s.observe(time.monotonic() - progress.since_s)
        else:
            self._metrics.sequences_failed.labels(job.reason).inc()

    async def _expire_now_and_then(self) -> None:
        while True:
            await self._shelf.expire()
            await asyncio.sleep(_EXPIRE_EVERY_S)

    def _usual_job_s(self) -> float:
        """How long until a place is free, as far as anybody can tell."""
        etas_s = [self.status(job_id).eta_s for job_id in self._running]
        known_s = [eta_s for eta_s in etas_s if eta_s is not None]
        if known_s:
            return max(known_s)
        return self._last_job_s


def _find(folder: Path, wanted: str | None, *, max_pixels: int) -> tuple[str, StereoSource]:
    check_folder(folder, max_pixels=max_pixels)
    spec = find_sequence(folder, wanted)
    return spec, open_below(folder, spec)


def _failed(job: Job, error: DepthError) -> Job:
    return replace(job, state=JobState.FAILED, reason=error.code, message=str(error))
