"""The progress of jobs: of one run, and as clients see it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from vergence_service.jobs.forecast import COLD_WORK, extra_work
from vergence_service.jobs.job import Job


def work_until(job: Job, frames: int) -> float:
    """Return the work of the first ``frames`` of a job, in megapixels of warm steps.

    The first frame is cold, and the other cold ones count as if they were spread evenly.
    """
    if not frames:
        return 0.0
    others = max(job.cold_expected - 1, 0) * (frames - 1) / max(job.frames - 1, 1)
    steps = frames * (1 + extra_work(job.options.quality))
    return job.megapixels * (steps + (COLD_WORK - 1) * (1 + others))


@dataclass(slots=True, eq=False)
class JobProgress:
    """The progress of one run of a job."""

    on_progress: Callable[[], None] = lambda: None
    since_s: float = field(default_factory=time.monotonic)
    frames_found: int = 0  # frames that earlier runs have done
    frames_done: int = 0  # all frames done, those of earlier runs included

    def advance(self, frames_done: int) -> None:
        """Record that so many frames are done."""
        self.frames_done = frames_done
        self.on_progress()

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.since_s

    @property
    def fps(self) -> float:
        return (self.frames_done - self.frames_found) / max(self.elapsed_s, 1e-6)

    def work_per_s(self, job: Job) -> float | None:
        """Return the work done in a second, or None before the first frame is done."""
        done = work_until(job, self.frames_done) - work_until(job, self.frames_found)
        return done / max(self.elapsed_s, 1e-6) if done else None


@dataclass(frozen=True, slots=True)
class JobStatus:
    """A job and its progress, at one moment."""

    job: Job
    frames_done: int
    ahead: int  # jobs that run before this one
    fps: float | None
    eta_s: float | None  # time until it is done, those before it included
    expires_s: float | None  # Unix time until which its result is kept, at least
