"""The worker: it runs the accepted jobs one after the other."""

import asyncio
import logging
import time
from dataclasses import asdict, dataclass, replace
from functools import partial

from vergence_proto.errors import (
    DepthError,
    Draining,
    InsufficientStorage,
    ModelFailed,
    NotReady,
    StateMemory,
)
from vergence_proto.jobs import JobState
from vergence_service.jobs.checkpoints import saved_frames
from vergence_service.jobs.etas import in_turn
from vergence_service.jobs.job import Job
from vergence_service.jobs.kept_uploads import KeptUploads
from vergence_service.jobs.progress import JobProgress
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.results import read_records
from vergence_service.jobs.run import CHECKPOINT, run_job
from vergence_service.jobs.storage import disk_trouble
from vergence_service.jobs.tally import tally_of
from vergence_service.process.failures import error_of
from vergence_service.streams.engine import DepthEngine

log = logging.getLogger(__name__)

# So many runs may begin at the same frame of a job and not be finished, because the server died or
# the model failed. Then the job is failed: it probably causes that.
_MAX_ATTEMPTS = 4
_EXPIRE_EVERY_S = 30.0
_LEAST_EXPIRE_S = 0.05
_LOOK_EVERY_S = 5.0  # whether live streams have come or gone
# Pause before trying again when the disk refused to read or write.
_TROUBLE_PAUSE_S = 1.0


@dataclass(slots=True, eq=False)
class _Run:
    """One run of one job."""

    progress: JobProgress
    task: asyncio.Task[None] | None = None
    stepped: bool = False  # the model is free, and the result is being finished


class JobWorker:
    """Steps the first jobs of the queue: as many as the model has lanes, or one beside streams."""

    def __init__(
        self, engine: DepthEngine, jobs: JobRegistry, *, checkpoint_s: float, uploads: KeptUploads
    ) -> None:
        self._engine = engine
        self._uploads = uploads
        self._jobs = jobs
        self._checkpoint_s = checkpoint_s
        self._runs: dict[str, _Run] = {}
        self._freed = asyncio.Event()  # a run has left the model, or has ended
        self._leaving = False  # the server is shutting down
        self._tasks: list[asyncio.Task[None]] = []
        self._metrics = engine.metrics
        self._metrics.sequence_disk_bytes.set_function(jobs.used_bytes)
        for state in (JobState.QUEUED, JobState.RUNNING):
            self._metrics.sequences.labels(state).set_function(partial(jobs.count, state))

    def start(self) -> None:
        """Run the waiting jobs, those of earlier servers first, until :meth:`stop`."""
        if self._leaving:
            return
        self._tasks = [
            asyncio.create_task(self._run_all(), name="sequences"),
            asyncio.create_task(self._expire_regularly(), name="expire results"),
        ]

    async def stop(self) -> None:
        """Stop at the current frame. The running job keeps its place for the next server."""
        self._leaving = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def cancel(self, job_id: str) -> None:
        """End the run of a job, if it runs."""
        run = self._runs.get(job_id)
        if run is not None and run.task is not None:
            run.task.cancel()
            await asyncio.gather(run.task, return_exceptions=True)

    async def _run_all(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            while not self._leaving:
                self._freed.clear()
                job = self._next()
                if job is None:
                    await self._change()
                    continue
                run = self._runs[job.job_id] = _Run(self._jobs.begin_run(job.job_id))
                run.task = tasks.create_task(self._run(job, run), name=f"sequence {job.job_id}")

    def _next(self) -> Job | None:
        """Return the job to run now, or None if none may run."""
        stepping = sum(not run.stepped for run in self._runs.values())
        # A job is stepped while the one before it is finished, for disks can be slow. More than
        # one that is being finished keep others waiting.
        finishing = len(self._runs) - stepping
        # Steps of one job follow each other, so it leaves cores idle that another job can use. The
        # last lane is for live streams.
        live = bool(self._engine.streams.attachments())
        if stepping >= (1 if live else self._engine.lanes) or finishing > 1:
            return None
        waiting = in_turn(self._jobs.unfinished(), self._runs)
        return next((each for each in waiting if each.job_id not in self._runs), None)

    async def _change(self) -> None:
        """Wait until another job may run, as far as that shows; look again in any case."""
        waits = [
            asyncio.create_task(self._freed.wait()),
            asyncio.create_task(self._jobs.change(within_s=_LOOK_EVERY_S)),
        ]
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for wait in waits:
                wait.cancel()

    async def _run(self, job: Job, run: _Run) -> None:
        try:
            try:
                ended = await self._stepped(job, run.progress)
            finally:
                self._jobs.end_stepping(job.job_id)
                run.stepped = True
                self._freed.set()
            if ended is not None:
                # Clients must not see the end of the job before the metrics do.
                counted = partial(self._count_ended, ended, run.progress)
                await self._jobs.finish(ended, on_kept=counted)
        except (Draining, NotReady):
            self._leaving = True
        except Exception as error:
            await self._wait_out(job, error)
        finally:
            del self._runs[job.job_id]
            self._freed.set()
            self._jobs.end_run(job.job_id)

    async def _wait_out(self, job: Job, error: Exception) -> None:
        """Let a job wait whose run failed for no fault of its own.

        It keeps its place and its input.
        """
        if (trouble := disk_trouble(error)) is None:
            why = error_of(error, log, f"sequence {job.job_id}")
        else:
            why = InsufficientStorage(
                f"{trouble} ({error}); the sequence waits, and continues by itself"
            )
            if job.message != str(why):
                log.warning("sequence %s waits: %s", job.job_id, why)
        await self._jobs.keep_waiting(
            replace(job, state=JobState.QUEUED, reason=why.code, message=str(why))
        )
        await asyncio.sleep(_TROUBLE_PAUSE_S)

    async def _stepped(self, job: Job, progress: JobProgress) -> Job | None:
        """Step the frames of a job.

        Returns the job as it is after success or failure, or None if it must be tried again.
        """
        folder = self._jobs.folder(job.job_id)
        saved = await self._engine.threads.background.run(saved_frames, folder / CHECKPOINT)
        attempts = job.attempts + 1 if saved == job.reached else 1
        if attempts > _MAX_ATTEMPTS:
            return _given_up(job)
        started = replace(
            job,
            state=JobState.RUNNING,
            attempts=attempts,
            reached=saved,
            reason=None,
            message=None,
            started_s=job.started_s or time.time(),
        )
        await self._jobs.update(started)
        # If the run before did not reach its first checkpoint, every frame of progress counts.
        checkpoint_s = self._checkpoint_s if attempts == 1 else 0.0

        try:
            found = await run_job(
                self._engine, folder, started, progress, checkpoint_s=checkpoint_s
            )
        except (Draining, NotReady, asyncio.CancelledError):
            # The sequence did not cause this: it keeps its place, for this server or the next.
            await self._jobs.keep_waiting(replace(job, state=JobState.QUEUED))
            raise
        except Exception as error:
            if disk_trouble(error) is not None:
                raise
            known = error_of(error, log, f"sequence {job.job_id}")
            if isinstance(known, NotReady):  # the server has no file descriptors left
                raise
            if not isinstance(known, ModelFailed | StateMemory):
                kept = await self._engine.threads.background.run(
                    tally_of, read_records(folder / "result")
                )
                started = replace(
                    started, reached=kept.frames, frames_failed=kept.failed, cold_frames=kept.cold
                )
                return _failed(started, known)
            # It may have been the moment, and not the frame.
            again = replace(_failed(started, known), state=JobState.QUEUED)
            await self._jobs.update(again)
            return None
        accuracy = None if found.accuracy is None else asdict(found.accuracy)
        return replace(
            started,
            state=JobState.DONE,
            fps=progress.fps or None,
            accuracy=accuracy,
            frames_failed=found.frames_failed,
            cold_frames=found.cold_frames,
            notes=found.notes,
        )

    def _count_ended(self, job: Job, progress: JobProgress) -> None:
        if job.state is JobState.DONE:
            self._metrics.sequences_done.inc()
            self._metrics.sequence_s.observe(progress.elapsed_s)
        else:
            self._metrics.sequences_failed.labels(job.reason).inc()

    async def _expire_regularly(self) -> None:
        while True:
            await self._jobs.expire()
            upload_s = await self._engine.threads.background.run(self._uploads.expire)
            wait_s = self._jobs.next_expiry_s(within_s=_EXPIRE_EVERY_S)
            wait_s = wait_s if upload_s is None else min(wait_s, upload_s)
            await asyncio.sleep(max(wait_s, _LEAST_EXPIRE_S))


def _given_up(job: Job) -> Job:
    where = f"{job.attempts} times before frame {job.reached} of {job.frames} was done"
    if job.reason is None:
        return _failed(job, ModelFailed(f"the server died {where}"))
    return _failed(job, ModelFailed(f"the model failed {where}: {job.message}"))


def _failed(job: Job, error: DepthError) -> Job:
    return replace(job, state=JobState.FAILED, reason=error.code, message=str(error))
