"""The progress of jobs: of one run, and as clients see it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from vergence_service.jobs.job import Job


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

    def eta_s(self, frames: int) -> float | None:
        """Return the time until all ``frames`` are done, or None before the first is done."""
        return (frames - self.frames_done) / self.fps if self.fps else None


@dataclass(frozen=True, slots=True)
class JobStatus:
    """A job and its progress, at one moment."""

    job: Job
    frames_done: int
    ahead: int  # jobs that run before this one
    fps: float | None
    eta_s: float | None  # time that its own remaining frames need
