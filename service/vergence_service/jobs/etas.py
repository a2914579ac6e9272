"""When the jobs of a queue will be done, from the speed of the last runs."""

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobProgress, work_until


@dataclass(frozen=True, slots=True)
class Place:
    """The place of an unfinished job."""

    ahead: int  # jobs before it
    work: float  # of the waiting ones before it


def in_turn(unfinished: Iterable[Job], running: Container[str]) -> list[Job]:
    """Return jobs in the order in which they run: those of each owner in turn.

    ``unfinished`` are in the order of one owner. Running ones are the first of their owner: they
    are not stopped for one of a higher priority.
    """
    seen: Counter[str] = Counter()
    ranked = []
    for job in sorted(unfinished, key=lambda job: job.job_id not in running):
        ranked.append((job.job_id not in running, seen[job.owner], job))
        seen[job.owner] += 1
    return [job for *_, job in sorted(ranked, key=lambda each: each[:2])]


def places_of(unfinished: Iterable[Job], running: Mapping[str, JobProgress]) -> dict[str, Place]:
    """Return the place of each unfinished job by its id; see :func:`in_turn` for their order."""
    places, work = {}, 0.0
    for ahead, job in enumerate(in_turn(unfinished, running)):
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
