"""The order and the keys of all jobs, so that lists and repeated submissions find them quickly."""

from bisect import bisect_left
from collections.abc import Callable, Mapping

from vergence_service.jobs.job import Job

_MOST_SCANNED = 2000  # jobs that one page of a list looks at


class JobIndex:
    """The ids of jobs, oldest first, and the clients' keys of their submissions."""

    def __init__(self) -> None:
        self._ids: list[tuple[int, str]] = []  # serial number and id
        self._serials: dict[str, int] = {}
        self._next = 0
        self._keys: dict[str, str] = {}  # from the key of a submission to the id

    def add(self, job: Job) -> None:
        """Add the newest job."""
        self._ids.append((self._next, job.job_id))
        self._serials[job.job_id] = self._next
        self._next += 1
        if job.key:
            self._keys[job.key] = job.job_id

    def remove(self, job: Job) -> None:
        """Remove a job that was added."""
        serial = self._serials.pop(job.job_id)
        del self._ids[bisect_left(self._ids, (serial, ""))]
        if self._keys.get(job.key) == job.job_id:
            del self._keys[job.key]

    def keyed(self, key: str) -> str | None:
        """Return the id of the job that was submitted with this key, if any."""
        return self._keys.get(key) if key else None

    def page(
        self,
        jobs: Mapping[str, Job],
        wanted: Callable[[Job], bool],
        *,
        size: int,
        below: int | None,
    ) -> tuple[list[str], int | None]:
        """Return ids of wanted jobs, newest first, and where the next page begins, if any.

        The cost does not grow with the number of jobs: a page may have fewer than ``size`` jobs,
        or none, although others follow. ``below`` is where an earlier page says this one begins.
        """
        end = len(self._ids) if below is None else bisect_left(self._ids, (below, ""))
        stop = max(end - _MOST_SCANNED, 0)
        found: list[str] = []
        for at in range(end - 1, stop - 1, -1):
            serial, job_id = self._ids[at]
            if wanted(jobs[job_id]):
                found.append(job_id)
            if len(found) == size:
                return found, serial if at else None
        return found, self._ids[stop][0] if stop else None
