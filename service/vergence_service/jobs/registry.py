"""All jobs of a server in memory: their state, progress and results, until they expire."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from vergence_proto.errors import (
    SequenceNotDone,
    UnknownSequence,
)
from vergence_proto.jobs import JobState
from vergence_service.access.principals import Principal
from vergence_service.jobs.etas import Place, eta_s, places_of
from vergence_service.jobs.index import JobIndex
from vergence_service.jobs.job import RANKS, Job
from vergence_service.jobs.progress import JobProgress, JobStatus
from vergence_service.jobs.results import has_frames
from vergence_service.jobs.storage import disk_trouble, flushing
from vergence_service.jobs.store import JobStore, folder_bytes
from vergence_service.process.threads import ThreadPool, to_the_end

# The expected duration of a job before any has run. Clients are asked to retry after it.
_USUAL_JOB_S = 2.0
_PROGRESS_EVERY_S = 0.25
_LONGEST_RETRY_S = 3600.0


class JobRegistry:
    """The jobs of a store, oldest first.

    Routes read it, the queue adds to it, and the worker changes it. All methods belong to the event
    loop; threads touch the files and the database.
    """

    def __init__(self, store: JobStore, *, keep_s: float, background: ThreadPool) -> None:
        self._store = store
        self._background = background
        self._keep_s = keep_s
        self._jobs: dict[str, Job] = {}
        self._index = JobIndex()
        self._running: dict[str, JobProgress] = {}
        self._readers: Counter[str] = Counter()
        self._changed = asyncio.Event()  # set at a change, and then replaced
        self._progress_due: asyncio.TimerHandle | None = None
        self._last_job_s = _USUAL_JOB_S
        self._work_per_s: float | None = None  # of the last run
        self._order: dict[str, Place] | None = None  # of the unfinished jobs; None: has changed

    async def load(self) -> None:
        """Read the jobs of earlier servers."""
        for job in await self._background.run(self._store.load):
            if job.ended and job.finished_up_s is None:  # by a version without this field
                job = replace(job, finished_up_s=self._store.uptime_s())
                await self._background.run(self._store.update, job)
            self._enter(job)

    def get(self, job_id: str) -> Job:
        """Return a job. Raises UnknownSequence."""
        if job_id not in self._jobs:
            raise self._unknown(job_id)
        return self._jobs[job_id]

    def _unknown(self, job_id: str) -> UnknownSequence:
        return UnknownSequence(
            f"no sequence {job_id[:64]!r}: it never existed, was deleted, or its result "
            f"expired, {self._keep_s / 3600:g} h after its end"
        )

    def check_owner(self, job_id: str, caller: Principal) -> None:
        """Raise UnknownSequence unless the job exists and ``caller`` may use it."""
        job = self.get(job_id)
        if not (caller.owns(job.owner) or (not caller.proven and not job.owner)):
            raise self._unknown(job_id)

    def unfinished(self) -> list[Job]:
        """Return the jobs that wait or run: by priority, and then oldest first."""
        unfinished = [job for job in self._jobs.values() if not job.ended]
        return sorted(unfinished, key=lambda job: RANKS[job.priority])

    def count(self, state: JobState) -> int:
        """Count the jobs in a state."""
        return sum(job.state is state for job in self._jobs.values())

    def status(self, job_id: str) -> JobStatus:
        """Return a job with its progress. Raises UnknownSequence."""
        job = self.get(job_id)
        if job.ended:
            done = job.frames if job.state is JobState.DONE else job.reached
            return JobStatus(job, done, 0, job.fps, None, self.expires_s(job))
        place = self._places()[job_id]
        progress = self._running.get(job_id)
        done = self._frames_done(job)
        fps = job.fps if progress is None else progress.fps or None
        running = [
            (self._jobs[each], run) for each, run in self._running.items() if each in self._jobs
        ]
        eta = eta_s(job, place, running, self._frames_done, self._work_per_s)
        return JobStatus(job, done, place.ahead, fps, eta, None)

    def _places(self) -> dict[str, Place]:
        if self._order is None:
            self._order = places_of(self.unfinished(), self._running)
        return self._order

    def expires_s(self, job: Job) -> float | None:
        """Return the Unix time until which the result of an ended job is kept, at least."""
        return None if job.finished_s is None else job.finished_s + self._keep_s

    def page(
        self, wanted: Callable[[Job], bool], *, size: int, below: int | None = None
    ) -> tuple[list[JobStatus], int | None]:
        """Return a page of jobs with their progress, see :meth:`JobIndex.page`."""
        job_ids, following = self._index.page(self._jobs, wanted, size=size, below=below)
        return [self.status(job_id) for job_id in job_ids], following

    def frames_of(self, job_id: str) -> tuple[JobStatus, Path]:
        """Return a job and the folder of its frames, of which ``frames_done`` can be read.

        Raises UnknownSequence.
        """
        return self.status(job_id), self.folder(job_id) / "result"

    def names(self) -> list[str]:
        """Return the ids of all jobs, and the keys of their submissions."""
        jobs = self._jobs.values()
        return [*self._jobs, *(job.key for job in jobs if job.key)]

    def has(self, name: str) -> bool:
        """Check for a job with this id, or submitted with this key."""
        return name in self._jobs or self.keyed(name) is not None

    def keyed(self, key: str) -> Job | None:
        """Return the job that was submitted with this key, if any."""
        job_id = self._index.keyed(key)
        return None if job_id is None else self._jobs.get(job_id)

    def result(self, job_id: str) -> tuple[Job, Path]:
        """Return a job that has ended with any result, and the folder of its result.

        Raises UnknownSequence, and SequenceNotDone if the job waits or runs, or ended before its
        first frame was done.
        """
        job = self.get(job_id)
        folder = self.folder(job_id) / "result"
        if job.state is not JobState.DONE and not (job.ended and has_frames(folder)):
            failure = f": {job.reason}: {job.message}" if job.state is JobState.FAILED else ""
            raise SequenceNotDone(
                f"sequence {job_id} has no result, it is {job.state}{failure}",
                retry_after_s=None if job.ended else self.usual_job_s(),
            )
        return job, folder

    @contextmanager
    def reading(self, job_id: str) -> Iterator[None]:
        """Keep the job's result from expiring until the block ends."""
        self._readers[job_id] += 1
        try:
            yield
        finally:
            self._readers[job_id] -= 1

    async def change(self, *, within_s: float) -> None:
        """Wait until a job begins, ends, is deleted or progresses, but at most ``within_s``.

        Progress is reported a few times a second, however fast it is.
        """
        with suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), within_s)

    def usual_job_s(self) -> float:
        """Estimate the time until the queue has a free place."""
        etas_s = [self.status(job_id).eta_s for job_id in self._running if job_id in self._jobs]
        return max((eta_s for eta_s in etas_s if eta_s is not None), default=self._last_job_s)

    def folder(self, job_id: str) -> Path:
        """Return the folder with the files of a job."""
        return self._store.folder(job_id)

    async def add(self, folder: Path, job: Job) -> None:
        """Add a job with its uploaded files. When this returns, a crash does not lose the job."""
        await to_the_end(self._add(folder, job))

    async def _add(self, folder: Path, job: Job) -> None:
        await self._background.finish(flushing(folder))
        await self._background.run(self._store.insert, folder, job)
        self._enter(job)
        self._notify_changed()

    def _enter(self, job: Job) -> None:
        self._jobs[job.job_id] = job
        self._index.add(job)

    def _leave(self, job_id: str) -> None:
        job = self._jobs.pop(job_id, None)
        if job is not None:
            self._index.remove(job)
            self._order = None

    def begin_run(self, job_id: str) -> JobProgress:
        """Record that the worker runs a job; return the progress of the run, for it to update."""
        progress = self._running[job_id] = JobProgress(on_progress=self._notify_soon)
        self._order = None
        return progress

    def end_stepping(self, job_id: str) -> None:
        """Record that the model is free again."""
        progress = self._running[job_id]
        self._last_job_s = progress.elapsed_s
        if job_id in self._jobs:
            self._work_per_s = progress.work_per_s(self._jobs[job_id]) or self._work_per_s

    def end_run(self, job_id: str) -> None:
        """Record that the worker does nothing more for a job, or begins with it again."""
        del self._running[job_id]
        self._notify_changed()

    async def update(self, job: Job) -> None:
        """Replace the entry of a job, unless it was deleted."""
        if self._cancelled(job):
            return
        await self._background.run(self._store.update, job)
        if job.job_id in self._jobs and not self._cancelled(job):
            self._jobs[job.job_id] = job
            self._notify_changed()

    def _cancelled(self, job: Job) -> bool:
        """Return whether a job was cancelled meanwhile: its run has nothing more to record."""
        known = self._jobs.get(job.job_id)
        return known is not None and known.state is JobState.CANCELLED

    def cancel(self, job_id: str) -> Job:
        """Let no run of a job begin or record anything; :meth:`finish` follows."""
        job = replace(self.get(job_id), state=JobState.CANCELLED, reason=None, message=None)
        self._jobs[job_id] = job
        self._notify_changed()
        return job

    async def keep_waiting(self, job: Job) -> None:
        """Record why a job waits: here, and on the disk if it can be written."""
        if self._cancelled(job):
            return
        if job.job_id in self._jobs:
            self._jobs[job.job_id] = job
            self._notify_changed()
        try:
            await self._background.run(self._store.update, job)
        except Exception as error:
            if disk_trouble(error) is None:
                raise

    async def finish(self, job: Job, *, on_kept: Callable[[], None]) -> None:
        """Record that a job has ended, and remove the files that it needs no more.

        ``on_kept`` is called when the end is on the disk, before anybody sees it here.
        """
        if job.state is not JobState.CANCELLED and self._cancelled(job):
            return
        used = 0
        result = self._store.folder(job.job_id) / "result"
        if await self._background.run(result.exists):
            await self._background.finish(flushing(result))
            used = await self._background.run(folder_bytes, result)
        kept = 0
        if job.keep_input:
            kept = await self._background.run(folder_bytes, result.parent / "input")
        job = replace(
            job,
            finished_s=time.time(),
            finished_up_s=self._store.uptime_s(),
            disk_bytes=used + kept,
            result_bytes=used,
        )
        await self._background.run(self._store.update, job)
        on_kept()
        if job.job_id in self._jobs:
            self._jobs[job.job_id] = job
            self._notify_changed()
        # Only now: a server that is killed before the row is written needs the input again.
        await self._background.run(self._store.tidy, job)

    def owing_webhooks(self) -> list[Job]:
        """Return the ended jobs whose webhook is neither delivered nor given up."""
        return [
            job
            for job in self._jobs.values()
            if job.webhook and not job.webhook_result and job.finished_s is not None
        ]

    async def note_webhook(self, job_id: str, result: str) -> None:
        """Record what became of the webhook of an ended job, unless it was deleted."""
        if job_id in self._jobs:
            job = self._jobs[job_id] = replace(self._jobs[job_id], webhook_result=result)
            await self._background.run(self._store.update, job)
            self._notify_changed()

    def hide(self, job_id: str) -> None:
        """Make a job unknown to readers at once; :meth:`delete` follows. Raises UnknownSequence."""
        self.get(job_id)
        self._leave(job_id)

    async def delete(self, job_id: str) -> None:
        """Delete a job with its row and its files."""
        self._leave(job_id)
        await self._background.run(self._store.delete, job_id)
        self._notify_changed()

    def used_bytes(self, *, owner: str | None = None) -> int:
        """Return the disk space that all jobs, or those of an owner, use or have reserved."""
        jobs = self._jobs.values()
        return sum(job.disk_bytes for job in jobs if owner is None or job.owner == owner)

    async def expire(self) -> None:
        """Delete the jobs that ended too long ago, by the time that servers have run since.

        The wall clock does not decide: it may jump by years when a machine starts.
        """
        await self._background.run(self._store.note_uptime)
        before_s = self._store.uptime_s() - self._keep_s
        for job in self._removable():
            if _ended_up_s(job) <= before_s:
                await self.delete(job.job_id)

    def promised_bytes(self) -> int:
        """Return the disk space that the results of unfinished jobs still need."""
        return sum(
            job.result_bytes - job.result_bytes * self._frames_done(job) // max(job.frames, 1)
            for job in self.unfinished()
        )

    def _frames_done(self, job: Job) -> int:
        progress = self._running.get(job.job_id)
        return job.reached if progress is None else progress.frames_done

    def room_in_s(self) -> float:
        """Estimate the time until a result expires, or a job ends that may fail."""
        up_s = self._store.uptime_s()
        waits_s = [
            max(_ended_up_s(job) + self._keep_s - up_s, 0.0)
            for job in self._jobs.values()
            if job.ended
        ]
        return min([*waits_s, _LONGEST_RETRY_S], default=_LONGEST_RETRY_S)

    def next_expiry_s(self, *, within_s: float) -> float:
        """Return the time until the next result expires, but at most ``within_s``."""
        up_s = self._store.uptime_s()
        ends_s = (_ended_up_s(job) + self._keep_s - up_s for job in self._removable())
        return min(max(min(ends_s, default=within_s), 0.0), within_s)

    def _removable(self) -> list[Job]:
        return [job for job in self._jobs.values() if job.ended and not self._readers[job.job_id]]

    def _notify_changed(self) -> None:
        self._order = None
        self._wake()

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    def _notify_soon(self) -> None:
        if self._progress_due is None:
            loop = asyncio.get_running_loop()
            self._progress_due = loop.call_later(_PROGRESS_EVERY_S, self._notify_progress)

    def _notify_progress(self) -> None:
        self._progress_due = None
        self._wake()


def _ended_up_s(job: Job) -> float:
    return job.finished_up_s or 0.0
