"""Client of a server's ``/v1/sequences``, which may be busy or unreachable for a while."""

import asyncio
import time
import zipfile
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

import httpx

from vergence.cli.errors import CliError
from vergence.transports.proxies import through_proxy
from vergence_proto.errors import DepthError, error_from_wire
from vergence_proto.jobs import JobState

# A server that restarts is expected to answer again within this time.
_PATIENCE_S = 60.0
_ASK_EVERY_S = 0.5
_CHUNK = 1 << 20
_UNAVAILABLE = {429, 503}

Query = dict[str, str | int | bool | list[str]]


@dataclass(frozen=True, slots=True)
class Job:
    """A sequence on the server, as ``/v1/sequences`` states it."""

    id: str
    state: JobState
    frames: int
    frames_done: int
    ahead: int
    """The number of jobs before this one."""
    fps: float | None
    accuracy: dict[str, float | None] | None
    """EPE and error rates, if they were requested and the sequence has ground truth."""
    reason: str | None
    """The error code of a failed job."""
    message: str | None
    frames_failed: int = 0
    """The number of frames without a map, because they could not be read or stepped."""
    notes: tuple[str, ...] = ()
    """What is missing in the upload or does not fit."""

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Read the fields that the commands use; a newer server may send others."""
        return cls(
            id=values["id"],
            state=JobState(values["state"]),
            frames=values["frames"],
            frames_done=values["frames_done"],
            ahead=values["ahead"],
            fps=values["fps"],
            accuracy=values["accuracy"],
            reason=values["reason"],
            message=values["message"],
            frames_failed=values.get("frames_failed", 0),
            notes=tuple(values.get("notes", ())),
        )


@dataclass(frozen=True, slots=True)
class SequenceService:
    """Requests to a server; each is repeated while the server is unreachable or has no room.

    Every method raises the class of :mod:`vergence_proto.errors` that the server names, and
    CliError if the server cannot be reached for a minute.
    """

    http: httpx.AsyncClient

    async def submit(self, archive: Path, query: Query) -> Job:
        """Upload an archive, and wait for a place in the queue for as long as it takes."""
        size = (await asyncio.to_thread(archive.stat)).st_size
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
        while True:
            answer = await self._patiently(
                lambda: self.http.post(
                    "/v1/sequences", params=query, content=_chunks(archive), headers=headers
                )
            )
            if answer.status_code not in _UNAVAILABLE or "Retry-After" not in answer.headers:
                break
            await asyncio.sleep(float(answer.headers["Retry-After"]))
        return _checked_job(answer)

    async def watch(self, job: Job) -> AsyncIterator[Job]:
        """Yield the job twice a second until it has ended."""
        while True:
            yield job
            if job.state.ended:
                return
            await asyncio.sleep(_ASK_EVERY_S)
            ask = partial(self.http.get, f"/v1/sequences/{job.id}")
            job = _checked_job(await self._patiently(ask))

    async def fetch(self, job: Job, form: str, target: Path) -> None:
        """Download the result of a job: a folder of files, or a film."""
        target.parent.mkdir(parents=True, exist_ok=True)
        film = form == "mp4"
        file = target.with_name(target.name + (".mp4" if film else ".zip.part"))
        url = f"/v1/sequences/{job.id}/result"

        async def download() -> httpx.Response:
            async with self.http.stream("GET", url, params={"format": form}) as answer:
                if answer.is_error:
                    await answer.aread()
                    return answer
                with file.open("wb") as sink:
                    async for chunk in answer.aiter_bytes(_CHUNK):
                        await asyncio.to_thread(sink.write, chunk)
            return answer

        answer = await self._patiently(download)
        if answer.is_error:
            raise _error_of(answer)
        if not film:
            await asyncio.to_thread(_unpack, file, target)

    async def forget(self, job: Job) -> None:
        """Delete the job and its files on the server."""
        await self._patiently(lambda: self.http.delete(f"/v1/sequences/{job.id}"))

    async def _patiently(self, ask: Callable[[], Awaitable[httpx.Response]]) -> httpx.Response:
        since_s = time.monotonic()
        while True:
            try:
                return await ask()
            except httpx.TransportError as error:
                if time.monotonic() - since_s > _PATIENCE_S:
                    through = through_proxy(str(self.http.base_url)) if self.http.trust_env else ""
                    raise CliError(f"cannot reach {self.http.base_url}{through}: {error}") from None
            await asyncio.sleep(_ASK_EVERY_S)


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while chunk := await asyncio.to_thread(file.read, _CHUNK):
            yield chunk


def _checked_job(answer: httpx.Response) -> Job:
    if answer.is_error:
        raise _error_of(answer)
    return Job.from_json(answer.json())


def _error_of(answer: httpx.Response) -> DepthError | CliError:
    if answer.headers.get("Content-Type") == "application/problem+json":
        problem = answer.json()
        if "reason" in problem:
            return error_from_wire(problem["reason"], problem["detail"])
    return CliError(f"{answer.url} answered {answer.status_code}: is it a Vergence server?")


def _unpack(archive: Path, folder: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder)  # extractall keeps all names below the folder
    archive.unlink()
