"""Accepted sequences, stepped one after the other."""

import asyncio
import logging
import time
from dataclasses import asdict, dataclass, field, replace
from functools import partial

from vergence_proto.errors import DepthError, Draining, ModelFailed, NotReady
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.run import JobProgress, run_job
from vergence_service.streams.engine import DepthEngine

log = logging.getLogger(__name__)

# A sequence that was running so often when the server died is taken to be the cause.
_MAX_ATTEMPTS = 4
_EXPIRE_EVERY_S = 30.0
# Before trying again what the disk refused.
_TROUBLE_PAUSE_S = 5.0
# What a job is taken to need before one has run; clients are told to come back after it.
_USUAL_JOB_S = 2.0


@dataclass(slots=True, eq=False)
class _Running:
    progress: JobProgress = field(default_factory=JobProgress)
    task: asyncio.Task[None] | None = None
    stepped: asyncio.Event = field(default_factory=asyncio.Event)  # the model is free again


class JobWorker:
    """Steps one job of the registry at a time, so that a sequence is done as early as it can be."""

    def __init__(self, engine: DepthEngine, registry: JobRegistry, *, checkpoint_s: float) -> None:
        self._engine = engine
        self._registry = registry
        self._checkpoint_s = checkpoint_s
        self._running: dict[str, _Running] = {}  # at most one is stepped, one is being put away
        self._leaving = False  # the server is shutting down
        self._last_job_s = _USUAL_JOB_S
        self._tasks: list[asyncio.Task[None]] = []
        self._metrics = engine.metrics
        self._metrics.sequence_disk_bytes.set_function(registry.taken_bytes)
        for state in (JobState.QUEUED, JobState.RUNNING):
            self._metrics.sequences.labels(state).set_function(partial(registry.count, state))

    def start(self) -> None:
        """Run what waits, that of earlier servers first, until :meth:`stop`."""
        self._tasks = [
            asyncio.create_task(self._run_all(), name="sequences"),
            asyncio.create_task(self._expire_now_and_then(), name="expire results"),
        ]

    async def stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def progress(self, job_id: str) -> JobProgress | None:
        """How far a job is; None if it does not run."""
        running = self._running.get(job_id)
        return None if running is None else running.progress

    async def cancel(self, job_id: str) -> None:
        """End the job's run, if it runs."""
        running = self._running.get(job_id)
        if running is not None and running.task is not None:
            running.task.cancel()
            await asyncio.gather(running.task, return_exceptions=True)

    def usual_job_s(self) -> float:
        """How long until a place is free, as far as anybody can tell."""
        etas_s = [
            running.progress.eta_s(self._registry.get(job_id).frames)
            for job_id, running in self._running.items()
            if job_id in self._registry
        ]
        return max((eta_s for eta_s in etas_s if eta_s is not None), default=self._last_job_s)

    async def _run_all(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            before: asyncio.Task[None] | None = None
            while not self._leaving:
                waiting = self._registry.unfinished()
                job = next((each for each in waiting if each.job_id not in self._running), None)
                if job is None:
                    await self._registry.change(within_s=_EXPIRE_EVERY_S)
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
            await self._registry.finish(ended)
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
        await self._registry.update(started)

        try:
            folder = self._registry.folder(job.job_id)
            found = await run_job(
                self._engine,
                folder,
                started,
                running.progress,
                checkpoint_s=self._checkpoint_s,
            )
        except (Draining, NotReady, asyncio.CancelledError):
            # Not the sequence's doing: it keeps its place, for this server or the next one.
            await self._registry.update(replace(job, state=JobState.QUEUED))
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

    def _count_ended(self, job: Job, progress: JobProgress) -> None:
        if job.state is JobState.DONE:
            self._metrics.sequences_done.inc()
            self._metrics.sequence_s.observe(time.monotonic() - progress.since_s)
        else:
            self._metrics.sequences_failed.labels(job.reason).inc()

    async def _expire_now_and_then(self) -> None:
        while True:
            await self._registry.expire()
            await asyncio.sleep(_EXPIRE_EVERY_S)


def _failed(job: Job, error: DepthError) -> Job:
    return replace(job, state=JobState.FAILED, reason=error.code, message=str(error))
