"""When the jobs of a queue will be done, from the speed of the last runs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobProgress, work_until


@dataclass(frozen=True, slots=True)
class Place:
    """The place of an unfinished job."""

    ahead: int  # jobs before it
    work: float  # of the waiting ones before it


def places_of(unfinished: Sequence[Job], running: Mapping[str, JobProgress]) -> dict[str, Place]:
    """Return the place of each unfinished job by its id; ``unfinished`` are in their order."""
    places, work = {}, 0.0
    # A running job is not stopped for one of a higher priority.
    order = sorted(unfinished, key=lambda job: job.job_id not in running)
    for ahead, job in enumerate(order):
        runs = job.job_id in running
        places[job.job_id] = Place(0 if runs else ahead, work)
        if not runs:
            work += work_until(job, job.frames) - work_until(job, job.reached)
    return places


def eta_s(
    job: Job,
    place: Place,
    running: Sequence[tuple[Job, JobProgress]],
    frames_done: Callable[[Job], int],
    last_rate: float | None,
) -> float | None:
    """Estimate the time until a job is done; None: no job has done anything yet.

    ``last_rate`` is the work per second of the last run.
    """
    rates = {each.job_id: progress.work_per_s(each) for each, progress in running}
    rate = rates.get(job.job_id) or next(filter(None, rates.values()), last_rate)
    if not rate:
        return None

    def left(each: Job) -> float:
        return work_until(each, each.frames) - work_until(each, frames_done(each))

    before = 0.0
    if job.job_id not in rates:
        before = place.work + sum(left(each) for each, _ in running)
    return (before + left(job)) / rate
