"""The client of a server's jobs for notebooks and programs without an event loop.

Each call runs an event loop in a thread that ends with the call, because a notebook's own thread
has one that runs already.
"""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from vergence.jobs.client import DEFAULT_SERVER, AsyncBatchClient, Source
from vergence.jobs.frames import BatchFrame
from vergence.jobs.info import JobInfo
from vergence.jobs.job import AsyncBatchJob, Format, Output, Priority
from vergence_proto.geometry import RectifiedRig
from vergence_proto.jobs import JobState

Value = TypeVar("Value")

_AT_ONCE = 16  # frames that are fetched together


class BatchClient:
    """Submits whole sequences to a server, and reads their results.

    It needs no ``with``: it keeps no connection between two calls. The parameters are those of
    :class:`AsyncBatchClient`.
    """

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        *,
        token: str | None = None,
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
        patience_s: float = 60.0,
    ) -> None:
        self._client = partial(
            AsyncBatchClient, server, token=token, ca=ca, cert=cert, key=key, patience_s=patience_s
        )
        self._client()  # a wrong address or credential is an error now

    def submit(
        self,
        source: Source,
        *,
        outputs: Sequence[Output] = ("disparity",),
        name: str = "",
        labels: Mapping[str, str] | None = None,
        on_error: Literal["skip", "fail"] = "skip",
        iterations: int = 0,
        quality: Literal["fast", "steady", "best"] = "fast",
        metrics: bool = False,
        priority: Priority = "normal",
        keep_input: bool = False,
        webhook: str = "",
        rig: RectifiedRig | None = None,
        fps: float = 30.0,
    ) -> "BatchJob":
        """Upload a sequence; see :meth:`AsyncBatchClient.submit`."""

        async def submit(client: AsyncBatchClient) -> JobInfo:
            job = await client.submit(
                source,
                outputs=outputs,
                name=name,
                labels=labels,
                on_error=on_error,
                iterations=iterations,
                quality=quality,
                metrics=metrics,
                priority=priority,
                keep_input=keep_input,
                webhook=webhook,
                rig=rig,
                fps=fps,
            )
            return job.info

        return BatchJob(self, self._run(submit))

    def job(self, job_id: str) -> "BatchJob":
        """Return a job that was submitted before. Raises UnknownSequence."""

        async def find(client: AsyncBatchClient) -> JobInfo:
            return (await client.job(job_id)).info

        return BatchJob(self, self._run(find))

    def jobs(
        self, *, state: JobState | None = None, labels: Mapping[str, str] | None = None
    ) -> list[JobInfo]:
        """Return your jobs, newest first. Servers without tokens list none."""

        async def collect(client: AsyncBatchClient) -> list[JobInfo]:
            return [info async for info in client.jobs(state=state, labels=labels)]

        return self._run(collect)

    def _run(self, work: Callable[[AsyncBatchClient], Awaitable[Value]]) -> Value:
        async def main() -> Value:
            async with self._client() as client:
                return await work(client)

        return _in_a_thread(main)


class BatchJob:
    """A job on a server, as :class:`AsyncBatchJob`, whose methods wait."""

    def __init__(self, client: BatchClient, info: JobInfo) -> None:
        self._client = client
        self.info: JobInfo = info
        """The job as the server last stated it; :meth:`refresh` asks again."""

    @property
    def id(self) -> str:
        """The id of the job, for :meth:`BatchClient.job`."""
        return self.info.id

    def refresh(self) -> JobInfo:
        """Ask the server for the state of the job."""
        return self._run(lambda job: job.refresh())

    def wait(self) -> JobInfo:
        """Wait for the end of the job. Raises the error of a failed job."""
        return self._run(lambda job: job.wait())

    def cancel(self) -> JobInfo:
        """Stop the job; the frames that are done stay."""
        return self._run(lambda job: job.cancel())

    def rerun(
        self,
        *,
        outputs: Sequence[Output] | None = None,
        on_error: Literal["skip", "fail"] | None = None,
        quality: Literal["fast", "steady", "best"] | None = None,
        metrics: bool | None = None,
        name: str = "",
        labels: Mapping[str, str] | None = None,
        priority: Priority = "normal",
        keep_input: bool = False,
        webhook: str = "",
    ) -> "BatchJob":
        """Submit the sequence of this job again; see :meth:`AsyncBatchJob.rerun`."""

        async def rerun(job: AsyncBatchJob) -> JobInfo:
            again = await job.rerun(
                outputs=outputs,
                on_error=on_error,
                quality=quality,
                metrics=metrics,
                name=name,
                labels=labels,
                priority=priority,
                keep_input=keep_input,
                webhook=webhook,
            )
            return again.info

        return BatchJob(self._client, self._run(rerun))

    def delete(self) -> None:
        """Delete the job and its files on the server."""
        self._run(lambda job: job.delete())

    def manifest(self) -> Mapping[str, Any]:
        """Return what is known about the job; see :meth:`AsyncBatchJob.manifest`."""
        return self._run(lambda job: job.manifest())

    def frames(self, *, after: int = -1) -> Iterator[BatchFrame]:
        """Iterate over the frames as they are made; see :meth:`AsyncBatchJob.frames`."""
        ended = False
        while not ended:
            start = after
            found, ended = self._run(lambda job, at=start: job.next_frames(at, most=_AT_ONCE))  # type: ignore[misc] # the default binds it now
            for frame in found:
                yield frame
                after = frame.index
            # The error of a failed job comes after its last frame.
            ended = ended and not found

    def save(self, folder: str | Path, format: Format = "png16") -> Path:
        """Write the result to a folder; see :meth:`AsyncBatchJob.save`."""
        return self._run(lambda job: job.save(folder, format))

    def download(self, path: str | Path, format: str = "mp4") -> Path:
        """Write the result as one file; see :meth:`AsyncBatchJob.download`."""
        return self._run(lambda job: job.download(path, format))

    def _run(self, work: Callable[[AsyncBatchJob], Awaitable[Value]]) -> Value:
        async def run(client: AsyncBatchClient) -> Value:
            job = AsyncBatchJob(client._requests, self.info)  # noqa: SLF001  the same job
            try:
                return await work(job)
            finally:
                self.info = job.info

        return self._client._run(run)  # noqa: SLF001  the client is the job's own


def _in_a_thread(main: Callable[[], Coroutine[Any, Any, Value]]) -> Value:
    """Run a coroutine in a thread of its own; an interrupt of the caller cancels it."""
    outcome: list[Value] = []
    failure: list[BaseException] = []
    running: list[tuple[asyncio.AbstractEventLoop, asyncio.Task[Value]]] = []

    async def work() -> None:
        task = asyncio.ensure_future(main())
        running.append((asyncio.get_running_loop(), task))
        outcome.append(await task)

    def run() -> None:
        try:
            asyncio.run(work())
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=run, name="vergence-jobs")
    thread.start()
    try:
        thread.join()
    except BaseException:
        for loop, task in running:
            loop.call_soon_threadsafe(task.cancel)
        thread.join()
        raise
    if failure:
        raise failure[0]
    return outcome[0]
