"""A job on a server, for asyncio."""

import asyncio
import secrets
import time
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from pathlib import Path
from typing import Any, Literal

from vergence.jobs.fetching import fetch, fetch_bytes
from vergence.jobs.frames import BatchFrame
from vergence.jobs.info import JobInfo
from vergence.jobs.requests import Query, Requests
from vergence.jobs.saving import Saving, checked_format, make_room
from vergence_proto.errors import DepthError, SequenceNotDone, error_from_wire
from vergence_proto.geometry import RectifiedRig
from vergence_proto.job_results.frame_file import JobFrame, decode_frame, decode_record
from vergence_proto.jobs import JobState
from vergence_proto.ordered import in_order

SEQUENCES = "/v1/sequences"
_WAIT_S = 15.0  # of one request for the next frames
_LINES = 64
_AHEAD = 3  # frames that are fetched while one is used
_WATCH_EVERY_S = 0.5

Output = Literal["disparity", "depth", "confidence", "sigma", "left", "points"]
Priority = Literal["low", "normal", "high"]
Format = Literal[
    "png16", "png16mm", "pfm", "npz", "nerfstudio", "colmap", "tum", "kitti", "middlebury", "eth3d"
]


def new_key() -> Mapping[str, str]:
    """Return a header that lets a server accept a repeated submission only once."""
    return {"Idempotency-Key": f'"{secrets.token_hex(16)}"'}


class AsyncBatchJob:
    """A job on a server; :meth:`vergence.AsyncBatchClient.submit` makes it, or ``job`` there.

    Every method raises UnknownSequence if the job was deleted or has expired, and ConnectionLost if
    the server cannot be reached.
    """

    def __init__(self, requests: Requests, info: JobInfo) -> None:
        self._requests = requests
        self._path = f"{SEQUENCES}/{info.id}"
        self._rig: RectifiedRig | None = None
        self.info: JobInfo = info
        """The job as the server last stated it; :meth:`refresh` asks again."""

    @property
    def id(self) -> str:
        """The id of the job, for :meth:`vergence.AsyncBatchClient.job`."""
        return self.info.id

    async def refresh(self) -> JobInfo:
        """Ask the server for the state of the job."""
        answer = await self._requests.ask("GET", self._path)
        self.info = JobInfo.from_json(answer.json())
        return self.info

    async def watch(self) -> AsyncIterator[JobInfo]:
        """Yield the state of the job twice a second, until it has ended."""
        while True:
            yield self.info
            if self.info.state.ended:
                return
            await asyncio.sleep(_WATCH_EVERY_S)
            await self.refresh()

    async def wait(self) -> JobInfo:
        """Wait for the end of the job. Raises the error of a failed job."""
        async for _ in self.watch():
            pass
        self._check()
        return self.info

    async def cancel(self) -> JobInfo:
        """Stop the job; the frames that are done stay."""
        answer = await self._requests.ask("POST", f"{self._path}/cancel")
        self.info = JobInfo.from_json(answer.json())
        return self.info

    async def rerun(
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
    ) -> "AsyncBatchJob":
        """Submit the sequence of this job again; return the new job. Nothing is uploaded.

        The job must have been submitted with ``keep_input=True``. Options that are left out are
        those of this job.

        Raises SequenceNotDone: the job has not kept its input.
        """
        stated: dict[str, Any] = {
            "output": outputs,
            "on_error": on_error,
            "quality": quality,
            "metrics": metrics,
        }
        query = {each: value for each, value in stated.items() if value is not None}
        marks = [f"{key}:{value}" for key, value in (labels or {}).items()]
        others = {"name": name, "label": marks, "priority": priority, "webhook": webhook}
        return await self.rerun_with({**query, **others, "keep_input": keep_input})

    async def rerun_with(self, query: Query) -> "AsyncBatchJob":
        """Submit the sequence again, with the options of the HTTP API."""
        answer = await self._requests.ask(
            "POST",
            f"{self._path}/rerun",
            query=query,
            headers=new_key(),
            when_full=True,
            unpacking=True,
        )
        return AsyncBatchJob(self._requests, JobInfo.from_json(answer.json()))

    async def delete(self) -> None:
        """Delete the job and its files on the server."""
        await self._requests.ask("DELETE", self._path)

    async def manifest(self) -> Mapping[str, Any]:
        """Return what is known about the job: model, options, rig, units, counts.

        Raises SequenceNotDone: no frame is done.
        """
        manifest: Mapping[str, Any] = (
            await self._requests.ask("GET", f"{self._path}/manifest")
        ).json()
        return manifest

    async def frames(self, *, after: int = -1) -> AsyncIterator[BatchFrame]:
        """Yield the frames in order, each when it is made, those without a map included.

        The iteration goes on through lost connections and restarts of the server, and ends with the
        job. ``after``: begin behind the frame of this index.

        Raises the error of a failed job, after its last frame.
        """
        async with aclosing(self._raw_frames(after)) as frames:
            async for frame in frames:
                yield BatchFrame.of(frame)
        self._check()

    async def next_frames(self, after: int, *, most: int) -> tuple[list[BatchFrame], bool]:
        """Return up to ``most`` frames behind ``after``, and whether no other will follow."""
        indices, ended = await self._ready(after, most)
        frames = [BatchFrame.of(await self._frame(index)) for index in indices]
        if ended and not frames:
            await self.refresh()
            self._check()
        return frames, ended

    async def save(
        self, folder: str | Path, format: Format = "png16", *, progress: Any = None
    ) -> Path:
        """Write the result to a folder, each frame when it is made; return the folder.

        A failed job leaves the frames before its failure, and then its error is raised.

        Parameters
        ----------
        folder
            A new or empty folder, or one with the result of another job, which is replaced.
        format
            The layout of the files.
        progress
            Called with each frame that was written.

        Raises
        ------
        FileExistsError
            The folder holds files that are no results.
        BadShape
            The job has not kept what the layout needs, for example the left images.
        """
        return await self.save_as(Path(folder), format, progress=progress)

    async def save_as(self, target: Path, form: str, *, progress: Any = None) -> Path:
        """Write the result as :meth:`save` does, in a format that is named by text."""
        checked_format(form)
        await asyncio.to_thread(make_room, target)
        saving: Saving | None = None
        async with aclosing(self._raw_frames(-1)) as frames:
            async for frame in frames:
                if saving is None:
                    saving = Saving(target, form, await self.manifest())
                await asyncio.to_thread(saving.write, frame)
                if progress is not None:
                    progress(BatchFrame.of(frame))
        if saving is not None:
            await asyncio.to_thread(saving.end, await self.manifest())
        self._check()
        return target

    async def download(self, path: str | Path, format: str = "mp4") -> Path:
        """Write the result as one file: a film, or an archive in any layout; return its path."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        await self.wait()

        with await asyncio.to_thread(target.open, "wb") as file:

            async def write(offset: int, chunk: bytes) -> None:
                if offset == 0:  # the first piece, or the server makes another archive
                    await asyncio.to_thread(file.seek, 0)
                    await asyncio.to_thread(file.truncate)
                await asyncio.to_thread(file.write, chunk)

            await fetch(self._requests, f"{self._path}/result", write, query={"format": format})
        return target

    async def _raw_frames(self, after: int) -> AsyncGenerator[JobFrame, None]:
        async with (
            aclosing(self._indices(after)) as indices,
            aclosing(in_order(indices, self._frame, limit=_AHEAD)) as frames,
        ):
            async for frame in frames:
                yield frame
        await self.refresh()

    async def _indices(self, after: int) -> AsyncGenerator[int, None]:
        ended = False
        while not ended:
            ready, ended = await self._ready(after, _LINES)
            for index in ready:
                yield index
                after = index

    async def _ready(self, after: int, most: int) -> tuple[list[int], bool]:
        """Wait for frames behind ``after``; return their indices, and whether none will follow."""
        query = {"after": after, "limit": most, "wait_s": _WAIT_S}
        while True:
            asked_s = time.monotonic()
            answer = await self._requests.ask("GET", f"{self._path}/frames", query=query)
            lines = answer.content.splitlines()
            ended = answer.headers.get("Vergence-Ended") == "true"
            if lines or ended:
                count = len(lines)
                return [*range(after + 1, after + 1 + count)], ended
            if time.monotonic() - asked_s < _WATCH_EVERY_S:  # the server is stopping
                await asyncio.sleep(_WATCH_EVERY_S)

    async def _frame(self, index: int) -> JobFrame:
        while True:
            try:
                data = await fetch_bytes(self._requests, f"{self._path}/frames/{index}")
                break
            except SequenceNotDone:  # a server that restarted steps it again
                await asyncio.sleep(_WATCH_EVERY_S)
        if self._rig is None and decode_record(data).error is None:
            rig = (await self.manifest())["rig"]
            self._rig = None if rig is None else RectifiedRig(**rig)
        return await asyncio.to_thread(decode_frame, data, self._rig)

    def _check(self) -> None:
        if self.info.state is JobState.FAILED:
            raise self._failure()

    def _failure(self) -> DepthError:
        return error_from_wire(str(self.info.reason), str(self.info.message))
